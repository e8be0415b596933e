"""The model under test, the simulator of its scenes where there is one, and the tests' run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import torch

from nmpm.data.format import Trajectory
from nmpm.data.recordings import RecordingReader
from nmpm.data.simulation import preset_metadata, try_seeds
from nmpm.data.windows import Recording, collate
from nmpm.emulator import Emulator
from nmpm.emulator.calibration import with_usual_gravity
from nmpm.emulator.similarity import Match
from nmpm.evaluation.stress import GROUPS
from nmpm.evaluation.stress.results import Effort, TestResult
from nmpm.particles import Particles, Window, thrown_blocks
from nmpm.scene import Reading
from nmpm.sim import Preset

_STREAM = 7
"""Keeps these scenes' seeds apart from those of the datasets."""


@dataclass(frozen=True)
class ModelUnderTest:
    """A trained emulator under test.

    Args:
        name: Its name in reports.
        emulator: In evaluation mode, on the device that the battery runs on.
        horizon: Frames that its training unrolled.
        preset: The simulator of its scenes; None where they were recorded.
        seed: Of the scenes.
        reading: How it takes those of a preset of another kind, whose frames are its own; as they are when None.
    """

    name: str
    emulator: Emulator
    horizon: int
    preset: Preset | None = None
    seed: int = 0
    reading: Reading | None = None

    def over(self, preset: Preset, match: Match) -> ModelUnderTest:
        """The same test on the scenes of another preset, with a match of the emulator with them."""
        reading = match.reading
        if reading == Reading(preset.scene):
            return replace(self, preset=preset)
        stride = Fraction(reading.every, reading.between)
        return replace(
            self,
            emulator=self.emulator.matched(match),
            preset=preset if stride == 1 else preset.with_stride(stride),
            reading=Reading(reading.scene, reading.materials),
        )

    def read(self, preset: Preset) -> Reading:
        """How scenes of a variant of the preset are read: in the model's materials, on whole cells."""
        scene = preset.scene
        if self.reading is None or self.preset is None:
            return Reading(scene)
        usual, domain = self.reading.scene, []
        sides = zip(usual.domain, self.preset.scene.bounds, scene.bounds, self.emulator.grid.spacing, strict=True)
        for (first, last), (_, high), (_, higher), h in sides:
            domain.append((first, last + h * max(0, math.ceil((higher - high) / h - 1e-6))))
        scene = replace(usual, bounds=scene.bounds, domain=tuple(domain), gravity=scene.gravity)
        return replace(self.reading, scene=scene)

    @property
    def device(self) -> torch.device:
        """Where the battery runs."""
        return self.emulator.device

    def starts(self, count: int) -> Particles:
        """Initial states of `count` scenes of the kind that the model was trained on; else one thrown block."""
        if self.preset is not None:
            return simulate_window(self, self.preset, count, 0).initial
        scene = self.emulator.scene
        few = max(1, min(1000, int(0.1 * scene.volume / scene.particle_volume)))
        state = with_usual_gravity(self.emulator, thrown_blocks(scene, count=few, seed=self.seed))
        return state.to(self.device)

    def entropies(self, count: int) -> list[tuple[int, int, int]]:
        """Numbers that the seeds of scenes outside of any dataset are derived from, see `nmpm.data.simulation`."""
        return [(self.seed, _STREAM, index) for index in range(count)]

    def with_emulator(self, emulator: Emulator) -> ModelUnderTest:
        """The same test of another emulator."""
        return replace(self, emulator=emulator)


def battery(model: ModelUnderTest, effort: Effort, groups: Iterable[str] = GROUPS) -> Iterator[TestResult]:
    """Run groups of tests, by name, on a model; yield each result as soon as it is known."""
    with torch.no_grad():
        for name in groups:
            yield from GROUPS[name](model, effort)


def simulate_window(model: ModelUnderTest, preset: Preset, count: int, frames: int) -> Window:
    """Some scenes of a preset with `frames` frames after the two that an emulator starts from, on the model's device.

    Raises:
        UnstableError: if the simulator does not stay stable from several seeds in a row.
    """
    reading = model.read(preset)
    made = [_record(preset, reading, entropy, frames, ()) for entropy in model.entropies(count)]
    return collate([recording for recordings in made for recording in recordings], reading).to(model.device)


def simulate_beside(
    model: ModelUnderTest, preset: Preset, count: int, frames: int, others: Sequence[Preset]
) -> Iterator[list[Window]]:
    """The scenes of `simulate_window` one by one, which bounds memory, each as the preset and as others simulate it.

    A scene in which any of them becomes unstable is replaced by another.
    """
    reading = model.read(preset)
    for entropy in model.entropies(count):
        recordings = _record(preset, reading, entropy, frames, others)
        yield [collate([recording], reading).to(model.device) for recording in recordings]


def _record(
    preset: Preset, reading: Reading, entropy: tuple[int, ...], frames: int, others: Sequence[Preset]
) -> list[Recording]:
    """One scene as the preset and others simulate it, from the first seed with which all stay stable."""
    reader = RecordingReader(preset_metadata(preset), reading)

    def simulate(seed: int) -> list[Recording]:
        start = preset.draw(seed)
        runs = [solver.simulate_from(start, frames + 1) for solver in (preset, *others)]
        stored = [Trajectory(run.position, run.particle_type, run.attributes) for run in runs]
        return [reader.recording(each, f"{preset.name}, seed {seed}") for each in stored]

    return try_seeds(entropy, simulate)
