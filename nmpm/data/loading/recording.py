"""Trajectories as tensors, validated against their scene.

A recording holds what a model needs of a trajectory: the moving particles, their materials and fields, the static
particles once, and gravity in length per frame squared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from nmpm._support.threads import raise_if_abandoned
from nmpm.data.fields import read_fields, require_fields
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.statistics import first_moving_particle, first_outside
from nmpm.errors import DataError
from nmpm.scene import Scene


@dataclass(frozen=True)
class Recording:
    """One trajectory of a known scene; all values are finite."""

    frames: Tensor  # (T, N, D) float32 positions of the moving particles, in domain length
    material: Tensor  # (N,) int64 index into `Scene.materials`
    obstacle: Tensor  # (M, D) float32 positions of the static particles
    gravity: Tensor  # (D,) float32 in length per frame squared, zero where unknown
    fields: Mapping[str, Tensor] = field(default_factory=dict)  # float32 (T, N), (1, N) if constant in time, or (1, 1)


@dataclass(frozen=True)
class RecordingReader:
    """Converts trajectories of a scene to recordings and validates them; the metadata name the type ids."""

    metadata: Metadata
    scene: Scene

    def recording(self, trajectory: Trajectory, where: str) -> Recording:
        """Converts a trajectory, with its fields as `read_fields` gives them; `where` names it in errors.

        Raises:
            DataError: if a particle leaves the scene's domain, its material is not in the scene, a static particle
                moves, or a field that the metadata declare is missing or not finite.
        """
        types = trajectory.particle_type
        moving, static = self.check(trajectory, where)
        mover = first_moving_particle(trajectory.position, static, self.scene.domain)
        if mover is not None:
            name = self.metadata.particle_types[int(types[mover])]
            raise DataError(
                f"{where}: particle {mover} is of the static type {types[mover]} ({name}) but moves. Obstacles must be"
                " at rest; to predict it like a material, remove its type from static_types in the metadata."
            )
        gravity = trajectory_gravity(trajectory.attributes, self.scene, where) or (0.0,) * self.scene.dim
        return Recording(
            frames=torch.from_numpy(np.ascontiguousarray(trajectory.position[:, moving])),
            material=torch.from_numpy(self._materials(types[moving], where)),
            obstacle=torch.from_numpy(trajectory.position[0, static]),
            gravity=(torch.tensor(gravity, dtype=torch.float64) * self.scene.dt**2).float(),
            fields=dict(self._fields(trajectory.fields, moving, where)),
        )

    def check(self, trajectory: Trajectory, where: str, first_frame: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Checks types and positions of a trajectory's frames, counted from `first_frame`; raises as `recording`.

        Returns:
            (N,) whether each particle moves, and whether it is static.
        """
        types = trajectory.particle_type
        self.metadata.check_types(types, where)
        moving = self.metadata.is_moving(types)
        static = self.metadata.is_static(types)
        if outside := first_outside(trajectory.position, self.scene.domain, self.scene.periodic, moving | static):
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
        return moving, static

    def _fields(self, fields: Mapping[str, np.ndarray], moving: np.ndarray, where: str) -> Iterator[tuple[str, Tensor]]:
        """The fields of the moving particles by name."""
        missing = [name for name in self.metadata.fields if name not in fields]
        if missing:
            raise DataError(f"{where}: it has no field {', '.join(missing)}, which the metadata or data.fields name.")
        for name, values in fields.items():
            wrong = ~np.isfinite(values) & (moving if values.shape[1] > 1 else True)
            if wrong.any():
                frame, particle = map(int, np.argwhere(wrong)[0])
                raise DataError(
                    f"{where}: {name} of particle {particle} in frame {frame} is {values[frame, particle]}; fields of"
                    " moving particles must be finite. Remove the trajectory, or leave the field out of data.fields."
                )
            yield name, torch.from_numpy(np.ascontiguousarray(values if values.shape[1] == 1 else values[:, moving]))

    def _materials(self, types: np.ndarray, where: str) -> np.ndarray:
        index = np.zeros(types.shape, dtype=np.int64)
        for type_id in np.unique(types).tolist():
            name = self.metadata.particle_types[type_id]
            if name not in self.scene.materials:
                raise DataError(
                    f"{where}: the material {name!r} (type {type_id}) is not in the scene, which has"
                    f" {', '.join(self.scene.materials)}. Remove the trajectory, or train on data that has both."
                )
            index[types == type_id] = self.scene.material_index(name)
        return index


class SplitRecordings(Sequence[Recording]):
    """The trajectories of a split as recordings, read and validated on access.

    Raises:
        DataError: if file and scene differ in the number of axes.
    """

    def __init__(self, split: Split, metadata: Metadata, scene: Scene) -> None:
        if split.dim != scene.dim:
            raise DataError(f"{split.path}: positions have {split.dim} dimensions, the scene has {scene.dim}.")
        self.split, self.scene = split, scene
        self.reader = RecordingReader(metadata, scene)

    def __len__(self) -> int:
        return len(self.split)

    def __getitem__(self, index: int) -> Recording:  # type: ignore[override]  # (no slices)
        names = dict.fromkeys((*self.reader.metadata.fields, *self.scene.fields))
        fields = read_fields(self.split, index, names) if names else {}
        return self.reader.recording(replace(self.split.read(index), fields=fields), self.split.where(index))

    @property
    def max_bytes(self) -> int:
        """Size of the positions and fields of the largest trajectory."""
        split, numbers = self.split, self.split.dim + len(self.reader.metadata.fields)
        return max(4 * split.frames(index) * split.particles(index) * numbers for index in range(len(self)))

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Reads several trajectories, until the task is cancelled."""
        recordings = []
        for index in indices:
            raise_if_abandoned()
            recordings.append(self[index])
        return recordings

    def check_ends(self) -> None:
        """Checks the first and the last frame of each trajectory, and that it has the fields, as reading all would."""
        require_fields(self.split, self.reader.metadata.fields)
        for index in range(len(self)):
            for frame in sorted({0, self.split.frames(index) - 1}):
                self.reader.check(self.split.read(index, frame, frame + 1), self.split.where(index), frame)

    def require_frames(self, frames: int, purpose: str) -> None:
        """Raises a DataError that names the first trajectory with fewer frames."""
        for index in range(len(self)):
            if self.split.frames(index) < frames:
                raise DataError(
                    f"{self.split.where(index)}: it has {self.split.frames(index)} frames, {purpose} needs {frames}."
                    " Shorten the horizon (frames per bundle x bundles unrolled) or remove the trajectory."
                )

    def close(self) -> None:
        """Does nothing: a split keeps no file open and no thread running."""
