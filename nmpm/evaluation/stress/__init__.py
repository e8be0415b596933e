"""The stress battery: a trained emulator at the extremes, one result of pass or fail for each.

`GROUPS` names the tests, `battery` runs them; what they share is `model.py`, `trace.py` and `results.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType

import torch

from nmpm.evaluation.stress.long import duration, energy_and_rest, settling
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.evaluation.stress.numerics import poison, precision, sensitivity
from nmpm.evaluation.stress.obstacles import obstacles
from nmpm.evaluation.stress.results import FULL, QUICK, Effort, TestResult
from nmpm.evaluation.stress.scenes import counts, sizes, speeds

__all__ = ["FULL", "GROUPS", "QUICK", "Effort", "ModelUnderTest", "TestResult", "battery"]

Group = Callable[[ModelUnderTest, Effort], Iterator[TestResult]]


def network_alone(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Energy, rest and obstacles where the emulator's constraints enforce them, without constraints.

    There is no verdict, as the rollouts that users get are constrained: the figure `holds` is 1 where the test would
    pass. Particles never leave the bounds, in either form. `settling` has results of both forms.
    """
    constraints, bare = model.emulator.constraints, model.with_emulator(model.emulator.unconstrained())
    if constraints.energy or constraints.rest_speed:
        yield from map(_without_verdict, energy_and_rest(bare, effort))
    if constraints.energy:
        yield from map(_without_verdict, speeds(bare, effort))
    if constraints.solids and not bare.emulator.constraints.solids:
        yield from map(_without_verdict, obstacles(bare, effort))


def _without_verdict(result: TestResult) -> TestResult:
    verdict = {} if result.passed is None else {"holds": float(result.passed)}
    figures = {**verdict, **result.figures}
    return dataclasses.replace(result, group="the network alone", passed=None, needs="", figures=figures)


GROUPS: Mapping[str, Group] = MappingProxyType(
    {
        "long": duration,
        "settling": settling,
        "speeds": speeds,
        "counts": counts,
        "sizes": sizes,
        "precision": precision,
        "sensitivity": sensitivity,
        "obstacles": obstacles,
        "poison": poison,
        "free": network_alone,
    }
)


def battery(model: ModelUnderTest, effort: Effort, groups: Mapping[str, Group] = GROUPS) -> Iterator[TestResult]:
    """Run the tests of an emulator, and yield each result as soon as it is known.

    Args:
        model: The emulator, and its simulator where there is one.
        effort: Amount of work.
        groups: The tests to run, by name.
    """
    with torch.no_grad():
        for group in groups.values():
            yield from group(model, effort)
