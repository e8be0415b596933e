"""Tests without constraints: those that a constraint makes pass whatever the network predicts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from nmpm.evaluation.stress.duration import energy_and_rest
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.obstacles import obstacles
from nmpm.evaluation.stress.speeds import speeds
from nmpm.evaluation.stress.subject import Subject

_GROUP = "the network alone"


def free(subject: Subject, size: Size) -> Iterator[Line]:
    """Energy, rest and obstacles where the emulator's constraints enforce them, without constraints.

    There is no verdict, as the rollouts that users get are constrained: the figure `holds` is 1 where the line would
    pass. Particles never leave the bounds, in either form. `settling` has lines of both forms.
    """
    held, bare = subject.emulator.constraints, subject.with_emulator(subject.emulator.unconstrained())
    if held.energy or held.rest_speed:
        yield from map(_without_verdict, energy_and_rest(bare, size))
    if held.energy:
        yield from map(_without_verdict, speeds(bare, size))
    if held.solids and not bare.emulator.constraints.solids:
        yield from map(_without_verdict, obstacles(bare, size))


def _without_verdict(line: Line) -> Line:
    verdict = {} if line.passed is None else {"holds": float(line.passed)}
    return dataclasses.replace(line, group=_GROUP, passed=None, needs="", figures={**verdict, **line.figures})
