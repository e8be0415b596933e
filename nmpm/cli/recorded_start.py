"""Recordings of `nmpm rollout --data`: how a model takes them where they are of another kind, and its errors."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nmpm.cli.match_options import MatchOptions, describe
from nmpm.cli.options import data_options
from nmpm.data.convert import native_file
from nmpm.data.convert.native import file_metadata, with_family
from nmpm.data.dataset import Dataset
from nmpm.data.facts import FOUND
from nmpm.data.format import METADATA_FILE, Metadata, Split, Trajectory
from nmpm.data.gravity import check_gravity, trajectory_gravity
from nmpm.data.loading.padded_batch import collate
from nmpm.data.loading.recording import SplitRecordings
from nmpm.data.loading.sources import FolderSource
from nmpm.data.volumes import VOLUME
from nmpm.emulator import Rollout
from nmpm.emulator.fields import warn_of_ignored
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import Comparison
from nmpm.metrics import MSE
from nmpm.particles import Window
from nmpm.scene import Reading, Scene, is_same_volume
from nmpm.zoo import Pretrained
from nmpm.zoo.matching import match_data
from nmpm.zoo.starts import is_gravity_of


@dataclass(frozen=True)
class RecordedStart:
    """A trajectory that a rollout starts from.

    Args:
        model: The model, matched to the data where they are of another kind.
        window: The trajectory at the model's frames, in its materials.
        written: The trajectory at the frames that are written: those of the data, or every k-th of them where the
            model's frames are so much longer; in the data's materials.
        scene: Of `written`.
        recordings: Of the trajectory's split, read as `written`.
        index: Of the trajectory.
        between: Frames of the model per written frame.
    """

    model: Pretrained
    window: Window
    written: Window
    scene: Scene
    recordings: SplitRecordings
    index: int
    between: int = 1

    def as_recorded(self, predicted: Trajectory) -> Trajectory:
        """A prediction with the ids and types that its particles have in the data."""
        return self.recordings.as_recorded(predicted, self.index)

    @classmethod
    def of(cls, model: Pretrained, options: argparse.Namespace) -> RecordedStart:
        """The trajectory of the options --data, --split and --trajectory, with the facts that others state.

        What matches it to the model is printed.

        Raises:
            ConfigError: if there is no such trajectory, or the model cannot be matched to the data.
        """
        path, index, facts = options.data, options.trajectory, data_options(options)
        split = Split(native_file(path, options.split, facts))
        if index >= len(split):
            raise ConfigError(f"--trajectory {index}: {path} contains trajectories 0 … {len(split) - 1}.")
        if split.frames(index) < 2:
            raise ConfigError(f"--trajectory {index}: it has one frame in {path}; a rollout starts from two.")
        facts = with_family(facts, split)
        metadata = file_metadata(split, facts)
        if facts.gravity is not None:
            check_gravity(facts.gravity, trajectory_gravity(split.attributes(index), metadata, ""), path)
        if split.path in (path, path / split.path.name):  # a converted copy has the facts
            metadata = facts.apply_to(metadata)
        stated = MatchOptions.read(options.materials, options.stride, options.strict)
        if stated.stride is None and is_of_kind(model.scene, metadata, split, index):
            warn_of_ignored(model.scene, metadata.fields)
            plain = Reading(model.scene)
            recordings = SplitRecordings(split, metadata, plain)
            window = collate([recordings[index]], plain)
            return cls(model, window, window, model.scene, recordings, index)
        beside = path == split.path and (path.parent / METADATA_FILE).is_file()
        data = Dataset(FolderSource(path.parent if beside else path, facts))
        match = match_data(model, data, *stated)
        sys.stdout.write(describe(match, model.name))
        scene = dataclasses.replace(data.scene, dt=data.scene.dt * match.reading.every)
        readings = (match.reading, Reading(scene, every=match.reading.every))
        predicted, recorded = (SplitRecordings(split, metadata, reading) for reading in readings)
        window, written = (collate([each[index]], each.reading) for each in (predicted, recorded))
        return cls(model.matched(match), window, written, scene, recorded, index, match.reading.between)


def is_of_kind(scene: Scene, metadata: Metadata, split: Split, index: int) -> bool:
    """Whether a trajectory can be read as one of a model's scene, as nothing that its file states is another.

    That is materials, obstacles, box, volume of particles, time between frames and gravity; bounds agree to a 64th of
    the box, gravity, which may be measured, to 5%. What could only be guessed, of a file that states nothing, decides
    nothing where the box may be the model's.
    """
    types = set(np.unique(split.particle_type(index)).tolist())
    names = {metadata.particle_types[i] for i in metadata.moving_types if i in types}
    if metadata.dim != scene.dim or not names <= set(scene.materials) or metadata.boundary != scene.boundary:
        return False
    obstacles, moving = types & metadata.obstacle_types, types & metadata.prescribed_types
    if (obstacles and not scene.obstacles) or (moving and not scene.moving_obstacles):
        return False
    guessed = {name for name, how in metadata.extra.get(FOUND, {}).items() if str(how).startswith("guessed")}
    ours, theirs = np.array(scene.bounds if "bounds" not in guessed else scene.domain), np.array(metadata.bounds)
    cell = float((ours[:, 1] - ours[:, 0]).max()) / 64
    within = (theirs[:, 0] > ours[:, 0] - cell).all() and (theirs[:, 1] < ours[:, 1] + cell).all()
    if not within or ("bounds" not in guessed and not np.allclose(theirs, ours, 0, cell)):
        return False
    attributes, volume = split.attributes(index), metadata.particle_volume
    if volume and VOLUME not in {*attributes, *guessed} and not is_same_volume(scene.particle_volume, volume):
        return False
    if scene.gravity_varies and "gravity" not in attributes:
        return False  # the model is told that of each trajectory
    gravity = trajectory_gravity(attributes, metadata, split.where(index))
    if not np.isclose(metadata.dt, scene.dt, rtol=1e-3):
        return gravity is None and "dt" in guessed
    return scene.gravity_varies or gravity is None or scene.gravity is None or is_gravity_of(scene, gravity)


def compared(window: Window, rollout: Rollout, options: argparse.Namespace) -> str:
    """Of which recording errors are, and over how many frames."""
    frames = min(window.target.shape[1], rollout.position.shape[1])
    return f"{options.data}, trajectory {options.trajectory}, {frames} frames:"


def recorded_errors(scene: Scene, bundle: int, window: Window, rollouts: Iterable[Rollout]) -> dict[str, float]:
    """Mean errors of rollouts against one recording, and of the trivial predictors, over the frames that both have."""
    comparison = Comparison(scene, [MSE()], bundle)
    for rollout in rollouts:
        frames = min(window.target.shape[1], rollout.position.shape[1])
        fields = {name: values[:, :frames] for name, values in rollout.fields.items()}
        comparison.update(window.first(frames + 2), rollout.position[:, :frames], fields)
    return {name: float(value) for name, value in comparison.compute().items()}
