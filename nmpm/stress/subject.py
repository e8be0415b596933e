"""What is put through the battery: a trained emulator, and the simulator of its scenes where there is one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from nmpm.data.format import Trajectory
from nmpm.data.generate import derive_seed, preset_metadata
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import RecordingReader
from nmpm.emulator import Emulator
from nmpm.particles import Particles, Window
from nmpm.sim import MpmPreset, Preset
from nmpm.starts import thrown_blocks

_STREAM = 7  # apart from the seeds of the datasets


@dataclass(frozen=True)
class Subject:
    """A trained emulator under test.

    Args:
        name: What it is called in reports.
        emulator: In evaluation mode.
        horizon: Frames that its training unrolled.
        preset: The simulator that made its training data; None where they were recorded.
        seed: Of the scenes.
    """

    name: str
    emulator: Emulator
    horizon: int
    preset: Preset | None = None
    seed: int = 0

    @property
    def simulator(self) -> MpmPreset | None:
        """The simulator, if its scenes can be varied."""
        return self.preset if isinstance(self.preset, MpmPreset) else None

    def starts(self, count: int) -> Particles:
        """Initial states of the scenes that the model was trained for: the simulator's, else one thrown block.

        Args:
            count: Scenes; without a simulator there is one.
        """
        if self.preset is not None:
            return simulated(self.preset, self.seeds(count), 0).initial
        scene = self.emulator.scene
        few = max(1, min(1000, int(0.1 * scene.volume / scene.particle_volume)))
        return thrown_blocks(scene, count=few, seed=self.seed)

    def seeds(self, count: int) -> list[int]:
        """Seeds of scenes that no dataset holds."""
        return [derive_seed(self.seed, _STREAM, index) for index in range(count)]

    def over(self, emulator: Emulator) -> Subject:
        """The same with another emulator."""
        return replace(self, emulator=emulator)


def simulated(preset: Preset, seeds: Sequence[int], frames: int) -> Window:
    """Scenes of a preset with `frames` frames after the two that an emulator starts from."""
    lasting, reader = preset.lasting(frames + 1), RecordingReader(preset_metadata(preset), preset.scene)
    made = [lasting.simulate(seed) for seed in seeds]
    recordings = [
        reader.recording(Trajectory(each.position, each.particle_type, each.attributes), f"{preset.name}, seed {seed}")
        for each, seed in zip(made, seeds, strict=True)
    ]
    return collate(recordings, preset.scene)
