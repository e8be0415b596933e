"""Trajectories as tensors, validated against their scene.

A recording holds what a model needs of a trajectory: the moving particles, their materials and fields, the obstacles,
at rest or moving as recorded, and gravity in length per frame squared. Where a particle is absent, its position and its
fields are those that it had last, or else will have first, so that all values are finite and no border of a period lies
between them. Materials, and the frames of which gravity is per frame squared, are those of a `nmpm.scene.Reading`; but
`frames` are still the data's.
"""

from __future__ import annotations

import itertools
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.threads import raise_if_abandoned
from nmpm.data.array_checks import check_end
from nmpm.data.fields import read_fields, require_fields
from nmpm.data.format import ID, Metadata, Split, Trajectory, split_paths
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.statistics import (
    are_outside,
    first_moving_particle,
    first_outside,
    float32_rounding,
    too_coarse,
    without_those_gone,
)
from nmpm.data.times import check_times
from nmpm.data.volumes import check_positive, mean_volume, split_volumes, stated_volumes
from nmpm.data.windows import Presence, Recording, collate, find_tracks, obstacle_frames, pin_for
from nmpm.errors import DataError
from nmpm.particles import Window
from nmpm.scene import Reading, Scene


@dataclass(frozen=True)
class RecordingReader:
    """Converts trajectories to recordings and validates them; the metadata name the type ids."""

    metadata: Metadata
    reading: Reading

    @property
    def scene(self) -> Scene:
        """The scene of the recordings."""
        return self.reading.scene

    def recording(
        self, trajectory: Trajectory, where: str, volume: np.ndarray | None = None, ids: np.ndarray | None = None
    ) -> Recording:
        """Converts a trajectory.

        Args:
            trajectory: The trajectory, with its fields as `read_fields` gives them.
            where: Names it in errors.
            volume: (N,) volumes of its particles, as multiples of the scene's `particle_volume`; None for 1, or what
                its attribute `particle_volume` states.
            ids: (T, N) numbers that tell particles apart that share a column; None where none do.

        Raises:
            DataError: if a particle leaves the scene's domain, its material is not in the scene, a static particle
                moves, or a field that the metadata declare is missing or not finite.
        """
        types = trajectory.particle_type
        moving, obstacle = self.check(trajectory, where)
        gravity = trajectory_gravity(trajectory.attributes, self.scene, where) or (0.0,) * self.scene.dim
        position = trajectory.position if moving.all() else trajectory.position[:, moving]
        check_end(position, where)
        position = without_those_gone(position, self.scene)
        presence = Presence.of(position)
        if presence is not None:
            presence.check(where)
            moving[moving] = presence.ever
            position = presence.fill(position[:, presence.ever])
        tracks = None if presence is None else find_tracks(presence.present, None if ids is None else ids[:, moving])
        obstacles = obstacle_frames(trajectory.position[:, obstacle], self.scene.moving_obstacles)
        volume = stated_volumes(trajectory, self.scene.particle_volume, where) if volume is None else volume
        columns = np.flatnonzero(moving)
        first = np.zeros_like(columns)
        if tracks is not None:
            columns, first = columns[tracks[:, 0]], tracks[:, 1]
        seen = np.flatnonzero(obstacle & ~np.isnan(trajectory.position[..., 0]).all(axis=0))
        source = np.pad(np.stack([columns, first], axis=1), ((0, len(seen)), (0, 0)))
        source[len(columns) :, 0] = seen
        return Recording(
            frames=torch.from_numpy(np.ascontiguousarray(position)),
            material=torch.from_numpy(self._materials(types[moving], where)),
            obstacle=torch.from_numpy(obstacles[0]),
            gravity=(torch.tensor(gravity, dtype=torch.float64) * self.scene.dt**2).float(),
            fields=self._fields(trajectory.fields, moving, presence, where),
            present=None if presence is None else torch.from_numpy(presence.present),
            tracks=tracks,
            obstacle_frames=torch.from_numpy(obstacles) if self.scene.moving_obstacles else None,
            volume=None if volume is None else torch.from_numpy(check_positive(volume, moving, where)),
            source=source,
        )

    def check(self, trajectory: Trajectory, where: str, first_frame: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Checks types and positions of a trajectory's frames, counted from `first_frame`; raises as `recording`.

        Returns:
            (N,) whether each particle moves and is predicted, and whether it is an obstacle.

        Warns:
            UserWarning: if particles at rest lie beyond the walls of the domain, and are no obstacles on its grid.
        """
        types, metadata = trajectory.particle_type, self.metadata
        metadata.check_types(types, where)
        moving = metadata.is_moving(types)
        position = without_those_gone(trajectory.position, self.scene)
        beyond = metadata.is_static(types) & are_outside(position[0], self.scene.domain, self.scene.boundary)
        if beyond.any():
            warnings.warn(f"{beyond.sum()} obstacle particles beyond the grid's walls are left out.", stacklevel=2)
        obstacle = metadata.is_obstacle(types) & ~beyond
        if outside := first_outside(position, self.scene.domain, self.scene.boundary, moving | obstacle):
            frame, particle, number = outside
            raise DataError(
                f"{where}: particle {particle} in frame {first_frame + frame} is at"
                f" {trajectory.position[frame, particle].tolist()}, outside"
                f" the domain {list(map(list, self.scene.domain))} ({number} particles leave"
                " it). Set a `domain` in the metadata that contains all positions, or remove the trajectory."
            )
        if not moving.any():
            raise DataError(f"{where}: no particle has a moving type; check static_types in the metadata.")
        self._materials(types[moving], where)
        resting = metadata.static_types if self.scene.moving_obstacles else metadata.obstacle_types
        mover = first_moving_particle(trajectory.position, np.isin(types, list(resting)), self.scene.domain)
        if mover is not None:
            number = int(types[mover])
            raise DataError(
                f"{where}: particle {mover} is of the static type {number} ({metadata.particle_types[number]}) but"
                f" moves. If it moves as recorded, like a paddle or a lid, add --prescribed {number} (fit:"
                f" --data.prescribed=[{number}]); to predict it like a material, remove its type from static_types in"
                " the metadata."
            )
        return moving, obstacle

    def _fields(
        self, fields: Mapping[str, np.ndarray], moving: np.ndarray, presence: Presence | None, where: str
    ) -> dict[str, Tensor]:
        """The fields of the moving particles by name."""
        missing = [name for name in self.metadata.fields if name not in fields]
        if missing:
            raise DataError(f"{where}: it has no field {', '.join(missing)}, which the metadata or data.fields name.")
        tensors = {}
        for name, stored in fields.items():
            values = stored if stored.shape[1] == 1 else stored[:, moving]
            values = presence.fill(values) if presence and values.shape == presence.present.shape else values
            if (wrong := ~np.isfinite(values)).any():
                frame, index = map(int, np.argwhere(wrong)[0])
                raise DataError(
                    f"{where}: {name} of particle {np.flatnonzero(moving)[index]} in frame {frame} is"
                    f" {values[frame, index]}; fields of moving particles must be finite. Remove the trajectory, or"
                    " leave the field out of data.fields."
                )
            tensors[name] = torch.from_numpy(np.ascontiguousarray(values))
        return tensors

    def _materials(self, types: np.ndarray, where: str) -> np.ndarray:
        index = np.zeros(types.shape, dtype=np.int64)
        for type_id in np.unique(types).tolist():
            name = self.reading.materials.get(stated := self.metadata.particle_types[type_id], stated)
            if name not in self.scene.materials:
                raise DataError(
                    f"{where}: the material {name!r} (type {type_id}) is not in the scene, which has"
                    f" {', '.join(self.scene.materials)}. Remove the trajectory, or train on data that has both."
                )
            index[types == type_id] = self.scene.materials.index(name)
        return index


class SplitRecordings(Sequence[Recording]):
    """Trajectories of a split as recordings, read and validated on access.

    Args:
        split: The split.
        metadata: Of its dataset.
        reading: How they are read, and the scene that they share.
        indices: Those of the trajectories in the split; all of them when None.

    Raises:
        DataError: if file and scene differ in the number of axes.

    Warns:
        UserWarning: if the scene is too far from the origin for the positions, which are float32.
    """

    def __init__(
        self, split: Split, metadata: Metadata, reading: Reading, indices: Sequence[int] | None = None
    ) -> None:
        if split.dim != reading.scene.dim:
            raise DataError(f"{split.path}: positions have {split.dim} dimensions, the scene has {reading.scene.dim}.")
        self.split, self.reading = split, reading
        self.indices = range(len(split)) if indices is None else indices
        self.reader = RecordingReader(metadata, reading)
        bounds = reading.scene.bounds
        corner = [low for low, _ in bounds]
        for sentence in too_coarse(reading.scene.particle_spacing, float32_rounding(bounds), corner):
            warnings.warn(f"{split.path.parent}: {sentence}", stacklevel=1)  # once for a dataset

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, number: int) -> Recording:  # type: ignore[override]  # (no slices)
        return self.at(self.indices[number])

    def at(self, index: int) -> Recording:
        """The trajectory that has this index in the split."""
        names = dict.fromkeys((*self.reader.metadata.fields, *self.reading.scene.fields))
        trajectory = replace(self.split.read(index), fields=read_fields(self.split, index, names))
        ids = self.split.tracks(index) if np.isnan(trajectory.position[..., 0]).any() else None
        return self.reader.recording(trajectory, self.split.where(index), self._relative_volumes(index), ids)

    def as_recorded(self, predicted: Trajectory, index: int) -> Trajectory:
        """A prediction of the trajectory of an index, with the ids and types that its particles have in the data."""
        (column, frame), metadata = self.at(index).source.T, self.reader.metadata
        ids = np.broadcast_to(self.split.ids(index), (self.split.frames(index), self.split.particles(index)))
        facts: dict[str, Any] = {
            "particle_types": json.dumps(metadata.particle_types),
            "static_types": np.array(sorted(metadata.static_types), dtype=np.int64),
            "prescribed_types": np.array(sorted(metadata.prescribed_types), dtype=np.int64),
        }
        return replace(
            predicted,
            particle_type=self.split.particle_type(index)[column],
            attributes=predicted.attributes | facts,
            fields=predicted.fields | {ID: ids[frame, column]},
        )

    @cached_property
    def _mean_volume(self) -> float | None:
        """The mean volume of the dataset's particles: of its first split, if there are splits beside this file."""
        beside = next(iter(split_paths(self.split.path.parent).values()), self.split.path)
        return mean_volume(Split(beside), self.reader.metadata)

    def _relative_volumes(self, index: int) -> np.ndarray | None:
        """(N,) volumes of a trajectory's particles over the mean one; None where all are alike."""
        if self._mean_volume is None:
            return None
        values = split_volumes(self.split, index)
        return None if values is None else values / self._mean_volume

    @property
    def frames(self) -> tuple[int, ...]:
        """Number of frames of each trajectory, of the dataset."""
        return tuple(map(self.split.frames, self.indices))

    def predicted_frames(self, index: int) -> int:
        """Frames of the model that a rollout of a trajectory of the split predicts."""
        return self.reading.model_frames(self.split.frames(index)) - 2

    @property
    def max_bytes(self) -> int:
        """Size of the positions and fields of the largest trajectory."""
        split, numbers = self.split, self.split.dim + len(self.reader.metadata.fields)
        return max(4 * split.frames(index) * split.particles(index) * numbers for index in self.indices)

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Reads several trajectories, until the task is cancelled."""
        recordings = []
        for index in indices:
            raise_if_abandoned()
            recordings.append(self[index])
        return recordings

    def check_ends(self) -> None:
        """Checks the times and the first and the last frame of each trajectory, and that it has the fields.

        Raises:
            DataError: if they are not as reading all would need them, or the steps in time of one are uneven.
        """
        require_fields(self.split, self.reader.metadata.fields)
        for index in self.indices:
            check_times(self.split.time(index), self.split.where(index))
            for frame in sorted({0, self.split.frames(index) - 1}):
                ends = self.split.read(index, frame, frame + 1)
                moving, _ = self.reader.check(ends, self.split.where(index), frame)
            if np.isnan(ends.position[:, moving]).all():
                check_end(self.split.read(index).position[:, moving], self.split.where(index))

    def with_frames(self, least: int, purpose: str) -> SplitRecordings:
        """Those of the trajectories that have enough frames; a warning counts the others.

        Args:
            least: Frames of the model that a trajectory needs.
            purpose: What needs them, in words.

        Raises:
            DataError: if no trajectory has as many.
        """
        frames, least = self.frames, self.reading.data_frames(least)
        if min(frames) >= least:
            return self
        if max(frames) < least:
            raise DataError(
                f"{self.split.path}: its longest trajectory has {max(frames)} frames, {purpose} needs {least}. Shorten"
                " the horizon, frames per bundle x bundles unrolled (--model.unroll), or record more frames."
            )
        enough = [index for index, count in zip(self.indices, frames, strict=True) if count >= least]
        warnings.warn(
            f"{self.split.path}: {len(frames) - len(enough)} of {len(frames)} trajectories have fewer than {least}"
            f" frames, {purpose}'s, and are left out.",
            stacklevel=2,
        )
        return self.subset(enough)

    def subset(self, indices: Sequence[int]) -> SplitRecordings:
        """Those of the split's trajectories that have these indices."""
        return SplitRecordings(self.split, self.reader.metadata, self.reading, indices)

    def close(self) -> None:
        """Does nothing: a split keeps no file open and no thread running."""


class EvaluationLoader:
    """Whole trajectories in batches of equal length; each trajectory goes to exactly one rank.

    Similar numbers of particles share a batch, so that few are padded much. `batches` holds the indices of each
    batch's trajectories. Trajectories with fewer than 3 frames are left out, with a warning that counts them. A
    rank without any has one batch of none, so that it takes part in all collectives.

    Args:
        recordings: The trajectories.
        batch_size: Trajectories per batch, at most.
        limit: Only the first `limit` trajectories; all when None.
        rank, world: Index of this process, and the number of processes.
        device: Where the batches are used; those for a GPU are in pinned memory.

    Raises:
        DataError: if all trajectories have fewer than 3 frames, so that there is nothing to predict.
    """

    def __init__(
        self,
        recordings: SplitRecordings,
        batch_size: int,
        limit: int | None = None,
        rank: int = 0,
        world: int = 1,
        device: torch.device | None = None,
    ) -> None:
        self.recordings, self.device = recordings, device or torch.device("cpu")
        self._batch_size, self._rank, self._world = batch_size, rank, world
        self._indices = recordings.with_frames(3, "an evaluation").indices
        self.restrict(limit)

    def restrict(self, limit: int | None) -> None:
        """Use only the first `limit` trajectories from now on; all when None."""
        split = self.recordings.split
        order = sorted(self._indices[:limit], key=split.frames)[self._rank :: self._world]
        batches: list[tuple[int, ...]] = []
        for _, equally_long in itertools.groupby(order, key=split.frames):
            by_size, size = sorted(equally_long, key=split.particles), self._batch_size
            batches += sorted(tuple(sorted(by_size[i : i + size])) for i in range(0, len(by_size), size))
        self.batches = tuple(batches) or ((),)

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Window]:
        return pin_for(self.device, map(self._read, self.batches))

    def _read(self, indices: Sequence[int]) -> Window:
        read = collate([self.recordings.at(index) for index in indices or self._indices[:1]], self.recordings.reading)
        return read.scenes(slice(len(indices)))
