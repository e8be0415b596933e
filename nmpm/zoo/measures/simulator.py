"""Uncertainty of the simulator itself: the test scenes simulated again, with other substeps or nudged positions.

The *twin* has other time steps; the *floor*, which no prediction gets below, starts from positions that differ by 10⁻⁶
of the domain.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.recording import RecordingReader
from nmpm.errors import UnstableError
from nmpm.metrics import MSE
from nmpm.sim import InitialState, Preset
from nmpm.sim.predictability import nudge, twin_of
from nmpm.zoo.measures.scenes import simulation_of, track_test_scenes
from nmpm.zoo.pretrained import Pretrained

NUDGE = 1e-6
"""Of the floor: standard deviation of the initial positions, as a share of the domain's longest side."""
Start = Callable[[Preset, int], InitialState]
"""The initial state of a preset for a seed."""


def twin_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `twin` of a card: mean errors of the simulator with other `substeps` than its `own_substeps`.

    Args:
        model: Of simulated data.
        folder: Not used.
        data: Folder of the dataset, which spares the simulation of the scenes themselves.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: naming the scenes that the other substeps make unstable.
    """
    preset, _ = simulation_of(model)
    other = twin_of(preset)
    errors, unstable = _compare("twin", model, other, lambda drawn, seed: drawn.draw(seed), data)
    if unstable:
        raise UnstableError(
            f"With {other.substeps} substeps test scenes {unstable} are unstable: {preset.name} has no twin."
        )
    return {"twin": {"substeps": other.substeps, "own_substeps": preset.substeps, **errors}}


def floor_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `floor` of a card: mean errors of the simulator started from positions nudged by `NUDGE`.

    Scenes that the nudge makes unstable are left out of the means and listed as `unstable`.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: if the nudge makes every scene unstable.
    """
    preset, _ = simulation_of(model)
    errors, unstable = _compare("floor", model, preset, _nudged, data)
    if not errors:
        raise UnstableError(f"A nudge of {NUDGE:g} makes all test scenes of {preset.name} unstable: it has no floor.")
    return {"floor": {"nudge": NUDGE, **errors, **({"unstable": unstable} if unstable else {})}}


def _nudged(preset: Preset, seed: int) -> InitialState:
    return nudge(preset, preset.draw(seed), NUDGE, seed)


def _compare(
    what: str, model: Pretrained, other: Preset, start: Start, data: Path | None
) -> tuple[dict[str, float], list[int]]:
    """Mean errors of another simulation of the test scenes, and which of them are unstable in it."""
    preset, request = simulation_of(model)
    reader = RecordingReader(preset_metadata(preset), model.scene)
    rows: list[dict[str, float]] = []
    unstable: list[int] = []
    for index, window in enumerate(track_test_scenes(what, model, data)):
        seed = request.trajectory_seed("test", index)
        try:
            run = other.simulate_from(start(preset, seed), preset.frames)
        except UnstableError:
            unstable.append(index)
            continue
        stored = Trajectory(run.position, run.particle_type, run.attributes)
        metric = MSE()
        metric.update(window, reader.recording(stored, f"{preset.name}, seed {seed}").frames[None, 2:])
        rows.append(metric.per_trajectory()[0])
    names = [name for name in rows[0] if all(name in row for row in rows)] if rows else []
    return {name: float(np.mean([row[name] for row in rows])) for name in names}, unstable
