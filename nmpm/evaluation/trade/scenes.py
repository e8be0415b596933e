"""The recorded scenes on which all choices are measured: those of a folder, or of an embedded dataset by its name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from nmpm.data.catalog import dataset_folder, ensure, find_simulated
from nmpm.data.convert import Options
from nmpm.data.recordings import SplitRecordings
from nmpm.data.simulation import SimulationRequest, generate
from nmpm.data.sources import FolderSource
from nmpm.data.survey import measure_motion
from nmpm.data.windows import Recording, collate, displacements
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Window
from nmpm.scene import Motion, Reading, Scene
from nmpm.sim import Preset, load_preset, preset_from_dict, preset_names

MOVING = 0.02
"""A scene moves as long as its root mean square speed is at least this share of the largest one."""
SHOWN = (0.1, 0.3, 1.0)
"""Shares of the first scene at which pictures show it: a splash, its return, and how it settles."""


@dataclass(frozen=True)
class Scenes:
    """Test trajectories of one family of scenes.

    Args:
        name: Of the dataset.
        scene: What they have in common.
        recordings: The trajectories, of at least 3 frames.
        preset: The simulator that made them; None if they were recorded, or made by an unknown simulator.
        seeds: Of each trajectory's initial state in the preset; empty without preset.
        source: Of the dataset, to measure speeds; None where they are not known.
    """

    name: str
    scene: Scene
    recordings: tuple[Recording, ...]
    preset: Preset | None = None
    seeds: tuple[int, ...] = ()
    source: FolderSource | None = None

    def __len__(self) -> int:
        return len(self.recordings)

    def frames(self, index: int) -> int:
        """Frames to predict: all but the two that a rollout starts from."""
        return len(self.recordings[index].frames) - 2

    def window(self, indices: Sequence[int], frames: int | None = None) -> Window:
        """Some scenes as one batch, with so many frames to predict; with all of the shortest when left out."""
        recordings = [self.recordings[index] for index in indices]
        length = min(len(recording.frames) for recording in recordings) if frames is None else frames + 2
        return collate(recordings, Reading(self.scene), length)

    def moving_frames(self, index: int) -> int:
        """Predicted frames until the scene comes to rest, see `MOVING`; at least 1."""
        return moving_frames(self.recordings[index], self.scene)

    def shown_frames(self) -> list[int]:
        """Indices of the predicted frames of the first scene that pictures show."""
        last = self.frames(0) - 1
        return sorted({round(share * last) for share in SHOWN})

    @cached_property
    def motion(self) -> Motion:
        """How the particles of the dataset move; unknown of scenes that are no dataset's."""
        return Motion() if self.source is None else measure_motion(self.source.folder, self.source.metadata)

    @cached_property
    def digests(self) -> tuple[str, ...]:
        """SHA-256 of what predictions and errors of each scene depend on, in short: its facts and its recording."""
        digests = []
        for recording in self.recordings:
            digest = hashlib.sha256(json.dumps(self.scene.to_dict(), sort_keys=True).encode())
            tensors = {name: getattr(recording, name) for name in ("frames", "material", "obstacle", "gravity")}
            tensors |= {f"field {name}": values for name, values in sorted(recording.fields.items())}
            optional = {name: getattr(recording, name) for name in ("present", "obstacle_frames", "volume")}
            tensors |= {name: values for name, values in optional.items() if values is not None}
            for name, values in tensors.items():
                digest.update(f";{name} {values.dtype} {tuple(values.shape)};".encode())
                digest.update(values.contiguous().numpy().tobytes())
            digests.append(digest.hexdigest()[:16])
        return tuple(digests)


def moving_frames(recording: Recording, scene: Scene) -> int:
    """Predicted frames until a recording comes to rest, see `MOVING`; at least 1."""
    speed = displacements(recording.frames[1:], scene).square().sum(-1).mean(-1).sqrt()
    moving = (speed >= MOVING * speed.max()).nonzero()
    return int(moving[-1]) + 1 if len(moving) else 1


def find_scenes(dataset: str, count: int, facts: Options | None = None) -> Scenes:
    """Test scenes of an embedded dataset or of data of any format that is read, `count` at most; simulated if missing.

    Facts are those that files do not state.

    Raises:
        ConfigError: if facts are stated of simulated scenes.
        DataError: if there is no such dataset, or its files are missing or wrong.
    """
    facts = facts or Options()
    if dataset in preset_names():
        _check_unstated(dataset, facts)
        folder = find_simulated(dataset, count) or ensure(dataset, {"train": 0, "valid": 0, "test": count})
        return read_scenes(dataset, FolderSource(folder), count)
    return read_scenes(Path(dataset).name, FolderSource(Path(dataset), facts), count)


def _check_unstated(name: str, facts: Options) -> None:
    """Raise ConfigError if facts are stated of simulated scenes."""
    stated = [fact for fact, value in vars(facts).items() if value is not None]
    if stated:
        raise ConfigError(f"--{stated[0]}: the scenes of {name} are simulated, and its facts known: leave it out.")


def find_wider_scenes(dataset: str, count: int, times: int) -> Scenes:
    """Scenes of an embedded dataset's simulator in a domain `times` as wide, with up to `times` as many particles.

    Raises:
        ConfigError: if the dataset is not an embedded one, as recorded scenes cannot be widened.
    """
    if dataset not in preset_names():
        raise ConfigError(
            f"{dataset} cannot be widened: it is not an embedded dataset. There are {', '.join(preset_names())}."
        )
    preset = load_preset(dataset).widened(times)
    request = SimulationRequest(preset, {"train": 0, "valid": 0, "test": count})
    name = f"{dataset}-{times}-times-as-wide"
    folder = dataset_folder(name, request)
    generate(preset, folder, request.counts, request.seed)
    return read_scenes(name, FolderSource(folder), count)


def read_scenes(name: str, source: FolderSource, count: int) -> Scenes:
    """The first `count` test trajectories of a dataset; fewer where the split has fewer.

    Raises:
        DataError: if files are missing or wrong.
        ConfigError: if the simulator's scenes are others than the dataset's, or facts are stated of them.
    """
    metadata = source.metadata
    simulation = metadata.extra.get("simulation")
    plain = simulation.get("preset") if isinstance(simulation, dict) else None
    preset = None if plain is None else preset_from_dict(plain)
    if preset is not None:
        _check_unstated(name, source.options)
    scene = source.scene if preset is None else preset.scene
    split = source.split("test")
    recordings = SplitRecordings(split, metadata, Reading(scene)).with_frames(3, "an evaluation")
    indices = recordings.indices[:count]
    scenes = Scenes(name, scene, tuple(map(recordings.__getitem__, range(len(indices)))), preset, source=source)
    if preset is None:
        return scenes
    seeds: list[Any] = [split.attributes(index).get("seed") for index in indices]
    missing = [index for index, seed in enumerate(seeds) if seed is None]
    if missing:
        raise DataError(f"{split.where(missing[0])}: the attribute seed is missing, by which it was simulated.")
    drawn, first = torch.from_numpy(preset.draw(int(seeds[0])).position).float(), scenes.recordings[0].frames[0]
    if drawn.shape != first.shape or not torch.allclose(drawn, first, atol=1e-5):
        raise ConfigError(
            f"The simulator {preset.name} does not draw the initial states of {name}: they were made by another version"
            " or preset. Simulate the dataset again, or measure without a simulator."
        )
    return replace(scenes, seeds=tuple(map(int, seeds)))
