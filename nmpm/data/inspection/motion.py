"""Positions and displacements of the particles of one trajectory that are predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.statistics import displacements

_NEIGHBOURS = 8
_QUERIES = 2000
_CROSSING = 0.8  # of the extent of all positions


@dataclass(frozen=True)
class Motion:
    """The motion of a trajectory's N moving particles over T frames; NaN where a particle is absent.

    Args:
        trajectory: The trajectory, with its fields.
        metadata: As stated.
        where: The trajectory in words, e.g. "train 00003".
    """

    trajectory: Trajectory
    metadata: Metadata
    where: str

    @cached_property
    def index(self) -> np.ndarray:
        """(N,) indices of the particles in the trajectory."""
        return np.flatnonzero(self.metadata.is_moving(self.trajectory.particle_type))

    @cached_property
    def position(self) -> np.ndarray:
        """(T, N, D)."""
        return self.trajectory.position[:, self.index]

    @cached_property
    def step(self) -> np.ndarray:
        """(T - 1, N, D) displacements between successive frames, by minimum image on periodic axes."""
        return displacements(self.position, self.metadata)

    @cached_property
    def speed(self) -> np.ndarray:
        """(T - 1, N) lengths of the displacements."""
        return np.asarray(np.linalg.norm(self.step, axis=-1))

    @cached_property
    def typical(self) -> np.ndarray:
        """(T - 1,) root mean square displacement of all particles between successive frames; 0 where none is there."""
        count = np.maximum(1, np.isfinite(self.speed).sum(axis=1))
        return np.asarray(np.sqrt(np.nansum(self.speed**2, axis=1) / count))

    @cached_property
    def present(self) -> np.ndarray:
        """(T, N) whether each particle is there."""
        return ~np.isnan(self.position[..., 0])

    @cached_property
    def crossings(self) -> np.ndarray:
        """(T - 1, N, D) whether a step leads from one end of all positions to the other, on axes that do not wrap."""
        extent = np.fmax.reduce(self.position, axis=(0, 1)) - np.fmin.reduce(self.position, axis=(0, 1))
        return np.asarray((np.abs(self.step) > _CROSSING * extent) & ~np.asarray(self.metadata.periodic))

    @cached_property
    def wraps(self) -> np.ndarray:
        """(T - 1, N, D) whether a step leads across the ends of a periodic axis, in coordinates that wrap or do not."""
        lower, upper = np.asarray(self.metadata.bounds).T
        periods = np.floor((self.position - lower) / (upper - lower))
        return np.asarray(
            (np.diff(periods, axis=0) != 0) | (np.abs(np.diff(self.position, axis=0)) > (upper - lower) / 2)
        ) & np.asarray(self.metadata.periodic)

    @cached_property
    def bounces(self) -> np.ndarray:
        """(T - 2, N, D) whether a particle on its way across an end of a periodic axis stays within."""
        lower, upper = np.asarray(self.metadata.bounds).T
        ahead, inside = self.position[1:-1] + self.step[:-1], (self.position >= lower) & (self.position <= upper)
        return np.asarray(
            ((ahead < lower) | (ahead > upper)) & inside[1:-1] & inside[2:] & ~self.wraps[1:]
        ) & np.asarray(self.metadata.periodic)

    @cached_property
    def rounding(self) -> float:
        """Distance of the largest coordinate to the next number in float32."""
        return float(np.spacing(np.float32(np.nanmax(np.abs(self.position)))))

    @cached_property
    def spacing(self) -> float:
        """Distance of neighbours on a square lattice that is as dense as the particles; 0 for fewer than two."""
        return spacing_of(self.position[self.fullest], self.metadata)

    @cached_property
    def fullest(self) -> int:
        """The first frame of those with the most particles."""
        return int(np.argmax(self.present.sum(axis=1))) if self.position.size else 0

    def tree(self, frame: int) -> tuple[cKDTree, np.ndarray]:
        """A search tree of the particles of a frame, and their indices among the N."""
        there = np.flatnonzero(self.present[frame])
        return neighbour_tree(self.position[frame, there], self.metadata), there


def neighbour_tree(position: np.ndarray, metadata: Metadata) -> cKDTree:
    """A search tree of (N, D) positions, which wraps on periodic axes; its data are relative to the bounds."""
    lower, upper = np.asarray(metadata.bounds, dtype=np.float64).T
    relative = position.astype(np.float64) - lower
    wraps = np.asarray(metadata.periodic)
    period = np.where(wraps, upper - lower, 0.0)  # cKDTree: 0 is not periodic
    return cKDTree(np.where(wraps, np.mod(relative, np.where(wraps, period, 1.0)), relative), boxsize=period)


def spacing_of(position: np.ndarray, metadata: Metadata) -> float:
    """The spacing of a lattice as dense as (N, D) positions around most particles; 0 for fewer than two."""
    there = position[~np.isnan(position[:, 0])]
    if len(there) < 2:
        return 0.0
    number, dim = min(_NEIGHBOURS, len(there) - 1), there.shape[1]
    tree = neighbour_tree(there, metadata)
    distance = tree.query(tree.data[:: -(-len(there) // _QUERIES)], k=[number + 1])[0]
    ball = math.pi ** (dim / 2) / math.gamma(dim / 2 + 1)
    return float(np.median(distance)) * float(ball / number) ** (1 / dim)
