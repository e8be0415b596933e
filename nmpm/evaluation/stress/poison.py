"""Non-finite inputs: they must be rejected where they enter, by name."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from torch import Tensor

from nmpm.data.format import Trajectory
from nmpm.emulator.rollouts import rollout
from nmpm.errors import DataError
from nmpm.evaluation.stress.lines import Line, Size
from nmpm.evaluation.stress.subject import Subject

_GROUP = "poison"
_BAD = (math.nan, math.inf, -math.inf)


def poison(subject: Subject, size: Size) -> Iterator[Line]:  # noqa: ARG001 (all groups share a signature)
    """NaN and infinity in a particle, a frame, a weight, a statistic."""
    yield _rejection_line("a position that is not finite", partial(_particle, subject, "position"))
    yield _rejection_line("a velocity that is not finite", partial(_particle, subject, "velocity"))
    yield _rejection_line("a trajectory with a frame that is not finite", partial(_frame, subject))
    if any(True for _ in subject.emulator.processor.parameters()):
        yield _rejection_line("a weight that is not finite", partial(_weight, subject))
    yield _rejection_line("a statistic that is not finite", partial(_statistic, subject))


def _rejection_line(name: str, attempt: Callable[[float], object]) -> Line:
    passed = 0
    for bad in _BAD:
        try:
            attempt(bad)
        except DataError:
            passed += 1
    return Line(_GROUP, name, passed == len(_BAD), {"refused": passed, "of": len(_BAD)}, "rejected by name")


def _particle(subject: Subject, what: str, bad: float) -> object:
    state = subject.starts(1)
    values = getattr(state, what).clone()
    values[0, 0, 0] = bad
    return rollout(subject.emulator, dataclasses.replace(state, **{what: values}), 1)


def _frame(subject: Subject, bad: float) -> object:
    position = np.full((4, 2, subject.emulator.scene.dim), 0.5, np.float32)
    position[2, 1, 0] = bad
    return Trajectory(position, np.zeros(2, np.int64))


def _weight(subject: Subject, bad: float) -> object:
    return _with_non_finite(subject, lambda emulator: next(iter(emulator.processor.parameters())), bad)


def _statistic(subject: Subject, bad: float) -> object:
    return _with_non_finite(subject, lambda emulator: emulator.output_scale, bad)


def _with_non_finite(subject: Subject, choose: Callable[..., Tensor], bad: float) -> object:
    emulator = copy.deepcopy(subject.emulator)
    values = choose(emulator).data
    values[(0,) * values.dim()] = bad
    return rollout(emulator, subject.starts(1), 1)
