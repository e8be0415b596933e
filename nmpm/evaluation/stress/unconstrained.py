"""The network alone: what the emulator's constraints enforce, without them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from nmpm.evaluation.stress.long import energy_and_rest
from nmpm.evaluation.stress.model import ModelUnderTest
from nmpm.evaluation.stress.obstacles import obstacles
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.evaluation.stress.scenes import speeds


def network_alone(model: ModelUnderTest, effort: Effort) -> Iterator[TestResult]:
    """Energy, rest and obstacles where the emulator's constraints enforce them, without constraints.

    There is no verdict, as the rollouts that users get are constrained: the figure `holds` is 1 where the test would
    pass. Particles never leave the bounds, in either form. `settling` has results of both forms.
    """
    constraints, bare = model.emulator.constraints, model.with_emulator(model.emulator.unconstrained())
    groups = [energy_and_rest] if constraints.energy or constraints.rest_speed else []
    groups += [speeds] if constraints.energy else []
    groups += [obstacles] if constraints.solids and not bare.emulator.constraints.solids else []
    for result in (result for group in groups for result in group(bare, effort)):
        verdict = {} if result.passed is None else {"holds": float(result.passed)}
        figures = {**verdict, **result.figures}
        yield dataclasses.replace(result, group="the network alone", passed=None, needs="", figures=figures)
