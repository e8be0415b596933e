"""Uncertainty of the simulator itself: the test scenes simulated again, with other substeps or nudged positions.

The *twin* has other time steps; the *floor*, which no prediction gets below, starts from positions that differ by 10⁻⁶
of the domain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.recording import RecordingReader
from nmpm.errors import UnstableError
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.sim import InitialState, Preset
from nmpm.sim.predictability import nudge, twin_of
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.scenes import simulation_of, track_test_scenes

NUDGE = 1e-6
"""Of the floor: standard deviation of the initial positions, as a share of the domain's longest side."""
Start = Callable[[Preset, int], InitialState]
"""The initial state of a preset for a seed."""


@dataclass(frozen=True)
class Twin:
    """The simulator with another number of substeps beside itself.

    Args:
        substeps: The twin's.
        own: Those of the data.
        errors: Means over the test scenes, "mse@100", …, "mse".
    """

    substeps: int
    own: int
    errors: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """As cards state it."""
        return {"substeps": self.substeps, "own_substeps": self.own, **self.errors}


@dataclass(frozen=True)
class Floor:
    """The simulator beside itself, started from positions nudged by `NUDGE`.

    Args:
        errors: Means over the test scenes that stay stable, "mse@100", …, "mse".
        unstable: The other test scenes.
    """

    errors: dict[str, float]
    unstable: tuple[int, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As cards state it."""
        left_out = {"unstable": list(self.unstable)} if self.unstable else {}
        return {"nudge": NUDGE, **self.errors, **left_out}


def twin_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `twin` of a card, see `measure_twin`."""
    return {"twin": measure_twin(model, data).to_dict()}


def floor_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `floor` of a card, see `measure_floor`."""
    return {"floor": measure_floor(model, data).to_dict()}


def measure_twin(model: Pretrained, data: Path | None = None) -> Twin:
    """Simulate a model's test scenes with other substeps and compare.

    Args:
        model: Of simulated data.
        data: Folder of the dataset, which spares the simulation of the scenes themselves.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: naming the scenes that the other substeps make unstable.
    """
    preset, _ = simulation_of(model)
    other = twin_of(preset)
    errors, unstable = _compare("twin", model, other, lambda own, seed: own.draw(seed), data)
    if unstable:
        raise UnstableError(
            f"With {other.substeps} substeps test scenes {unstable} are unstable: {preset.name} has no twin."
        )
    return Twin(other.substeps, preset.substeps, errors)


def measure_floor(model: Pretrained, data: Path | None = None) -> Floor:
    """Simulate a model's test scenes from nudged positions and compare.

    Args:
        model: Of simulated data.
        data: Folder of the dataset, as for `measure_twin`.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
        UnstableError: if the nudge makes every scene unstable.
    """
    preset, _ = simulation_of(model)
    errors, unstable = _compare("floor", model, preset, _nudged, data)
    if not errors:
        raise UnstableError(f"A nudge of {NUDGE:g} makes all test scenes of {preset.name} unstable: it has no floor.")
    return Floor(errors, tuple(unstable))


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
        rows.append(_errors(window, reader.recording(stored, f"{preset.name}, seed {seed}").frames))
    names = [name for name in rows[0] if all(name in row for row in rows)] if rows else []
    return {name: float(np.mean([row[name] for row in rows])) for name in names}, unstable


def _errors(window: Window, frames: torch.Tensor) -> dict[str, float]:
    metric = MSE()
    metric.update(window, frames[None, 2:])
    return metric.per_trajectory()[0]
