"""Trajectories as tensors.

A recording holds what a scene's model needs of a trajectory: the particles that move, their materials, the static
particles once, and gravity in length per frame squared. Everything a file may hold wrongly is found here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.loading.background import raise_if_abandoned
from nmpm.data.statistics import first_moving_particle
from nmpm.errors import DataError
from nmpm.scene import Scene


@dataclass(frozen=True)
class Recording:
    """One trajectory of a known scene.

    Args:
        frames: (T, N, D) float32 positions of the particles that move, in domain length.
        material: (N,) int64 index into `Scene.materials`.
        obstacle: (M, D) float32 positions of the particles that do not move.
        gravity: (D,) float32 in length per frame squared, zero where unknown.
    """

    frames: Tensor
    material: Tensor
    obstacle: Tensor
    gravity: Tensor


@dataclass(frozen=True)
class RecordingReader:
    """Makes recordings of trajectories, and checks what a file may hold wrongly.

    Args:
        metadata: What the type ids mean.
        scene: What the trajectories are recordings of.
    """

    metadata: Metadata
    scene: Scene

    def recording(self, trajectory: Trajectory, where: str) -> Recording:
        """The trajectory as tensors.

        Args:
            trajectory: A trajectory of the scene.
            where: Where it comes from, for messages.

        Raises:
            DataError: if it leaves the scene's domain, is of a material that the scene lacks, or has an obstacle that
                moves.
        """
        types = trajectory.particle_type
        self.metadata.check_types(types, where)
        moving = np.isin(types, self.metadata.moving_types)
        static = np.isin(types, list(self.metadata.static_types))
        self._check_inside(trajectory, moving | static, where)
        self._check_still(trajectory, static, where)
        if not moving.any():
            raise DataError(f"{where}: none of its particles moves; check static_types in the metadata.")
        return Recording(
            frames=torch.from_numpy(np.ascontiguousarray(trajectory.position[:, moving])),
            material=torch.from_numpy(self._materials(types[moving], where)),
            obstacle=torch.from_numpy(trajectory.position[0, static]),
            gravity=self._gravity(trajectory, where),
        )

    def _materials(self, types: np.ndarray, where: str) -> np.ndarray:
        index = np.zeros(types.shape, dtype=np.int64)
        for type_id in np.unique(types).tolist():
            name = self.metadata.particle_types[type_id]
            if name not in self.scene.materials:
                raise DataError(
                    f"{where}: its material {name!r} (type {type_id}) is unknown to the scene, which has"
                    f" {', '.join(self.scene.materials)}. Leave the trajectory out, or train on data that has both."
                )
            index[types == type_id] = self.scene.material_index(name)
        return index

    def _check_inside(self, trajectory: Trajectory, present: np.ndarray, where: str) -> None:
        lower, upper = np.asarray(self.scene.domain, dtype=np.float32).T
        # A periodic axis has no outside.
        walls = ~np.asarray(self.scene.periodic)
        position = trajectory.position
        outside = (((position < lower) | (position > upper)) & walls).any(axis=-1) & present
        if outside.any():
            frame, particle = map(int, np.argwhere(outside)[0])
            raise DataError(
                f"{where}: particle {particle} in frame {frame} is at {position[frame, particle].tolist()}, outside"
                f" the domain {list(map(list, self.scene.domain))} ({int(outside.any(axis=0).sum())} particles leave"
                " it). Give the metadata a `domain` that holds all positions, or leave the trajectory out."
            )

    def _check_still(self, trajectory: Trajectory, static: np.ndarray, where: str) -> None:
        particle = first_moving_particle(trajectory.position, static, self.scene.domain)
        if particle is not None:
            type_id = int(trajectory.particle_type[particle])
            raise DataError(
                f"{where}: particle {particle} is of the static type {type_id}"
                f" ({self.metadata.particle_types[type_id]}) but moves. Obstacles must be at rest; if it should be"
                " predicted like a material, take its type out of static_types in the metadata."
            )

    def _gravity(self, trajectory: Trajectory, where: str) -> Tensor:
        known = trajectory.attributes.get("gravity", self.scene.gravity)
        if known is None:
            return torch.zeros(self.scene.dim)
        gravity = torch.as_tensor(np.asarray(known, dtype=np.float64))
        if gravity.shape != (self.scene.dim,) or not gravity.isfinite().all():
            raise DataError(f"{where}: the attribute gravity = {known} should be {self.scene.dim} finite numbers.")
        return (gravity * self.scene.dt**2).float()


class SplitRecordings(Sequence[Recording]):
    """The trajectories of a split as recordings, read and checked when asked for.

    Args:
        split: The file.
        metadata: What its type ids mean.
        scene: What they are recordings of.
    """

    def __init__(self, split: Split, metadata: Metadata, scene: Scene) -> None:
        if split.dim != scene.dim:
            raise DataError(f"{split.path}: positions have {split.dim} dimensions, the scene has {scene.dim}.")
        self.split, self.scene = split, scene
        self.reader = RecordingReader(metadata, scene)

    def __len__(self) -> int:
        return len(self.split)

    def __getitem__(self, index: int) -> Recording:  # type: ignore[override]  # (no slices)
        """Reads one trajectory.

        Raises:
            DataError: if it cannot be read, leaves the scene's domain or is of a material that the scene lacks.
        """
        return self.reader.recording(self.split.read(index), self.split.where(index))

    @property
    def max_bytes(self) -> int:
        """Size of the positions of the largest trajectory."""
        split = self.split
        return max(4 * split.frames(index) * split.particles(index) * split.dim for index in range(len(self)))

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Reads several trajectories."""
        return list(map(self._next, indices))

    def _next(self, index: int) -> Recording:
        raise_if_abandoned()
        return self[index]

    def require_frames(self, frames: int, purpose: str) -> None:
        """Makes sure that every trajectory is long enough.

        Raises:
            DataError: naming the first that is shorter.
        """
        for index in range(len(self)):
            if self.split.frames(index) < frames:
                raise DataError(
                    f"{self.split.where(index)}: it has {self.split.frames(index)} frames, {purpose} needs {frames}."
                    " Shorten the horizon (frames per bundle x bundles unrolled) or leave the trajectory out."
                )
