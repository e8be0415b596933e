"""The model under test, and the simulator of its scenes where there is one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from nmpm.data.format import Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.initial_states import thrown_blocks
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader
from nmpm.data.seeds import derive_seed
from nmpm.emulator import Emulator
from nmpm.particles import Particles, Window
from nmpm.sim import Preset

_STREAM = 7
"""Keeps these scenes' seeds apart from those of the datasets."""


@dataclass(frozen=True)
class Subject:
    """A trained emulator under test.

    Args:
        name: Its name in reports.
        emulator: In evaluation mode, on the device that the battery runs on.
        horizon: Frames that its training unrolled.
        preset: The simulator of its training data; None where they were recorded.
        seed: Decides the scenes.
    """

    name: str
    emulator: Emulator
    horizon: int
    preset: Preset | None = None
    seed: int = 0

    @property
    def device(self) -> torch.device:
        """Where the battery runs."""
        return self.emulator.device

    def starts(self, count: int) -> Particles:
        """Initial states of scenes of the kind that the model was trained on: the simulator's, else one thrown block.

        Args:
            count: Scenes; without a simulator there is one.
        """
        if self.preset is not None:
            return simulate_window(self, self.preset, count, 0).initial
        scene = self.emulator.scene
        few = max(1, min(1000, int(0.1 * scene.volume / scene.particle_volume)))
        return thrown_blocks(scene, count=few, seed=self.seed).to(self.device)

    def seeds(self, count: int) -> list[int]:
        """Seeds of scenes that no dataset holds."""
        return [derive_seed(self.seed, _STREAM, index) for index in range(count)]

    def with_emulator(self, emulator: Emulator) -> Subject:
        """The same test of another emulator."""
        return replace(self, emulator=emulator)


def simulate_window(subject: Subject, preset: Preset, count: int, frames: int, solver: Preset | None = None) -> Window:
    """Scenes of a preset with `frames` frames after the two that an emulator starts from, on the subject's device.

    Args:
        subject: Gives the seeds of the scenes.
        preset: Draws their initial states.
        count: Scenes.
        frames: Frames after the first two.
        solver: Simulates them; left out, the preset itself.
    """
    return _window(subject, preset, subject.seeds(count), frames, solver)


def simulate_scenes(
    subject: Subject, preset: Preset, count: int, frames: int, solver: Preset | None = None
) -> Iterator[Window]:
    """The scenes of `simulate_window` one by one, which bounds the memory of long ones."""
    for seed in subject.seeds(count):
        yield _window(subject, preset, [seed], frames, solver)


def _window(subject: Subject, preset: Preset, seeds: list[int], frames: int, solver: Preset | None) -> Window:
    reader, recordings = RecordingReader(preset_metadata(preset), preset.scene), []
    for seed in seeds:
        trajectory = (solver or preset).simulate_from(preset.draw(seed), frames + 1)
        stored = Trajectory(trajectory.position, trajectory.particle_type, trajectory.attributes)
        recordings.append(reader.recording(stored, f"{preset.name}, seed {seed}"))
    return collate(recordings, preset.scene).to(subject.device)
