"""Uncertainty of the simulator itself: the test scenes simulated again, with other substeps or nudged positions.

The *twin* has other time steps; the *floor*, which no prediction gets below, starts from positions that differ by 10⁻⁶
of the domain.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.errors import UnstableError
from nmpm.metrics import MSE
from nmpm.sim import SimulatedTrajectory
from nmpm.sim.preset import nudge, twin_of
from nmpm.zoo.measures.scenes import as_recording, iterate_scenes, simulation_of
from nmpm.zoo.pretrained import Pretrained

NUDGE = 1e-6
"""Of the floor: standard deviation of the initial positions, as a share of the domain's longest side."""


def twin_facts(model: Pretrained, data: Path | None) -> dict[str, Any]:
    """The key `twin` of a card: mean errors of the simulator with other `substeps` than its `own_substeps`.

    Args:
        model: Of simulated data.
        data: Folder of the dataset, which spares the simulation of the scenes themselves.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: naming the scenes that the other substeps make unstable.
    """
    preset, _ = simulation_of(model)
    other = twin_of(preset)
    errors, unstable = _compare("twin", model, data, lambda seed: other.simulate_from(preset.draw(seed), preset.frames))
    if unstable:
        raise UnstableError(
            f"With {other.substeps} substeps test scenes {unstable} are unstable: {preset.name} has no twin."
        )
    return {"twin": {"substeps": other.substeps, "own_substeps": preset.substeps, **errors}}


def floor_facts(model: Pretrained, data: Path | None) -> dict[str, Any]:
    """The key `floor` of a card: mean errors of the simulator started from positions nudged by `NUDGE`.

    Scenes that the nudge makes unstable are left out of the means and listed as `unstable`.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: if the nudge makes every scene unstable.
    """
    preset, _ = simulation_of(model)

    def simulate(seed: int) -> SimulatedTrajectory:
        return preset.simulate_from(nudge(preset, preset.draw(seed), NUDGE, seed), preset.frames)

    errors, unstable = _compare("floor", model, data, simulate)
    if not errors:
        raise UnstableError(f"A nudge of {NUDGE:g} makes all test scenes of {preset.name} unstable: it has no floor.")
    return {"floor": {"nudge": NUDGE, **errors, **({"unstable": unstable} if unstable else {})}}


def _compare(
    what: str, model: Pretrained, data: Path | None, simulate: Callable[[int], SimulatedTrajectory]
) -> tuple[dict[str, float], list[int]]:
    """Mean errors of another simulation of the test scenes from their seeds, and which of them are unstable in it."""
    preset, request = simulation_of(model)
    metric, unstable = MSE(), []
    for index, window in enumerate(iterate_scenes(f"{what} of {model.name}", model, data)):
        seed = request.trajectory_seed("test", index)
        try:
            run = simulate(seed)
        except UnstableError:
            unstable.append(index)
            continue
        metric.update(window, as_recording(model, preset, run, seed).frames[None, 2:])
    rows = metric.per_trajectory()
    names = [name for name in (rows[0] if rows else ()) if all(name in row for row in rows)]
    return {name: float(np.mean([row[name] for row in rows])) for name in names}, unstable
