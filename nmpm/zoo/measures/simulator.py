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
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.sim import InitialState, Preset
from nmpm.sim.nudge import nudge
from nmpm.sim.twin import twin_of
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


def twin_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `twin` of a card, see `measure_twin`."""
    return {"twin": measure_twin(model, data).to_dict()}


def floor_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The key `floor` of a card, see `measure_floor`."""
    return {"floor": {"nudge": NUDGE, **measure_floor(model, data)}}


def measure_twin(model: Pretrained, data: Path | None = None) -> Twin:
    """Simulate a model's test scenes with other substeps and compare.

    Args:
        model: Of simulated data.
        data: Folder of the dataset, which spares the simulation of the scenes themselves.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
    """
    preset, _ = simulation_of(model)
    other = twin_of(preset)
    return Twin(other.substeps, preset.substeps, _compare("twin", model, other, lambda own, seed: own.draw(seed), data))


def measure_floor(model: Pretrained, data: Path | None = None) -> dict[str, float]:
    """Simulate a model's test scenes from nudged positions and compare: means over the scenes, "mse@100", …, "mse".

    Args:
        model: Of simulated data.
        data: Folder of the dataset, as for `measure_twin`.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
    """
    preset, _ = simulation_of(model)
    return _compare("floor", model, preset, lambda own, seed: nudge(own, own.draw(seed), NUDGE, seed), data)


def _compare(what: str, model: Pretrained, other: Preset, start: Start, data: Path | None) -> dict[str, float]:
    """Mean errors of another simulation of the test scenes."""
    preset, request = simulation_of(model)
    reader = RecordingReader(preset_metadata(preset), model.scene)
    rows = []
    for index, window in enumerate(track_test_scenes(what, model, data)):
        seed = request.trajectory_seed("test", index)
        run = other.simulate_from(start(preset, seed), preset.frames)
        stored = Trajectory(run.position, run.particle_type, run.attributes)
        rows.append(_errors(window, reader.recording(stored, f"{preset.name}, seed {seed}").frames))
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return {name: float(np.mean([row[name] for row in rows])) for name in names}


def _errors(window: Window, frames: torch.Tensor) -> dict[str, float]:
    metric = MSE()
    metric.update(window, frames[None, 2:])
    return metric.per_trajectory()[0]
