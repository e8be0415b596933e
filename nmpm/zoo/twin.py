"""What the simulator of a model's data is itself uncertain about: its test scenes, simulated with other time steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.recording import RecordingReader
from nmpm.errors import ConfigError
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.sim import Preset
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.scenes import iterate_test_scenes, simulation_of


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


def twin_of(preset: Preset) -> Preset:
    """The preset with half as many substeps; with the fewest that the solver accepts where those are too few for it.

    Where it accepts no fewer, with twice as many.
    """
    for substeps in (-(-preset.substeps // 2), preset.stable_substeps):
        if substeps < preset.substeps:
            with suppress(ConfigError):
                return dataclasses.replace(preset, substeps=substeps)
    return dataclasses.replace(preset, substeps=2 * preset.substeps)


def measure_twin(model: Pretrained, data: Path | None = None) -> Twin:
    """Simulate a model's test scenes with other substeps and compare.

    Args:
        model: Of simulated data.
        data: Folder of the dataset, which spares the simulation of the scenes themselves.

    Raises:
        ConfigError: if the data are not simulated, or by another revision of the simulator.
    """
    preset, request = simulation_of(model)
    other = twin_of(preset)
    rows = list(_rows(model, preset, other, request.trajectory_seed, data))
    names = [name for name in rows[0] if all(name in row for row in rows)]
    return Twin(other.substeps, preset.substeps, {name: float(np.mean([row[name] for row in rows])) for name in names})


def _rows(
    model: Pretrained, preset: Preset, other: Preset, seed_of: Callable[[str, int], int], data: Path | None
) -> Iterator[dict[str, float]]:
    reader = RecordingReader(preset_metadata(preset), model.scene)
    for index, window in enumerate(iterate_test_scenes(model, None, data)):
        seed = seed_of("test", index)
        run = other.simulate_from(preset.draw(seed), preset.frames)
        stored = Trajectory(run.position, run.particle_type, run.attributes)
        yield _errors(window, reader.recording(stored, f"{preset.name}, seed {seed}").frames)


def _errors(window: Window, frames: torch.Tensor) -> dict[str, float]:
    metric = MSE()
    metric.update(window, frames[None, 2:])
    return metric.per_trajectory()[0]
