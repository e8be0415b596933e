"""Positions and displacements of the particles of one trajectory that are predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.statistics import displacements, neighbour_tree, without_those_gone

_NEIGHBOURS = 8
_QUERIES = 2000
_KEPT = 0.7  # of the median distance to the nearest particle, that 90% keep; at random it is 0.39 in a plane
_CROSSING = 0.8  # of the extent of all positions
_GOES_ON = 0.5  # of a step: the steps before and after one across ends differ by less
_MOST = 0.5  # of the steps across ends
_NEAR = 1.5  # spacings
_OUTWARD = 0.02  # spacings in a frame: slower particles may just come to rest
_RESTLESS = 0.2  # likewise: particles whose typical step is longer do not cross ends, they are anywhere


@dataclass(frozen=True)
class Motion:
    """The motion of a trajectory's N moving particles over T frames; NaN where a particle is absent."""

    trajectory: Trajectory  # with its fields
    metadata: Metadata  # as stated
    where: str  # the trajectory in words, e.g. "train 00003"

    @cached_property
    def index(self) -> np.ndarray:
        """(N,) indices of the particles in the trajectory."""
        return np.flatnonzero(self.metadata.is_moving(self.trajectory.particle_type))

    @cached_property
    def position(self) -> np.ndarray:
        """(T, N, D); absent is also who has left the bounds of an open axis."""
        return without_those_gone(self.trajectory.position[:, self.index], self.metadata)

    @cached_property
    def step(self) -> np.ndarray:
        """(T - 1, N, D) displacements between successive frames, by minimum image on periodic axes."""
        return displacements(self.position, self.metadata)

    @cached_property
    def speed(self) -> np.ndarray:
        """(T - 1, N) lengths of the displacements."""
        return lengths(self.step)

    @cached_property
    def change(self) -> np.ndarray:
        """(T - 2, N) lengths of the differences of successive displacements."""
        return lengths(np.diff(self.step, axis=0))

    @cached_property
    def typical(self) -> np.ndarray:
        """(T - 1,) root mean square displacement between successive frames; NaN where no particle is in both."""
        count = np.isfinite(self.speed).sum(axis=1)
        return np.asarray(np.sqrt(np.nansum(self.speed**2, axis=1) / np.where(count, count, np.nan)))

    @cached_property
    def present(self) -> np.ndarray:
        """(T, N) whether each particle is there."""
        return np.asarray(~np.isnan(self.position[..., 0]))

    @cached_property
    def extent(self) -> np.ndarray:
        """(D, 2) lowest and highest coordinates."""
        return np.stack([ends.reduce(self.position, axis=(0, 1)) for ends in (np.fmin, np.fmax)], 1, dtype=np.float64)

    @cached_property
    def stays(self) -> np.ndarray:
        """(D, 2) share of the frames in which a particle is within a spacing of the lowest or highest coordinates."""
        low, high = self.extent.T + np.array([[self.spacing], [-self.spacing]])
        return np.stack([near.any(axis=1).mean(axis=0) for near in (self.position < low, self.position > high)], axis=1)

    @cached_property
    def crossings(self) -> np.ndarray:
        """(D, T - 1, N) whether a particle leaves at one end of all positions and goes on from the other as it came.

        Particles that reappear with another velocity, or elsewhere along the other axes, are moved by somebody. Steps
        on periodic axes are none.
        """
        crosses = np.zeros((self.metadata.dim, *self.speed.shape), dtype=bool)
        sizes = self.extent[:, 1] - self.extent[:, 0]
        for axis in np.flatnonzero(~np.asarray(self.metadata.periodic)):
            step = np.abs(self.step[..., axis])
            crosses[axis] = step > _CROSSING * sizes[axis]
            particles = np.flatnonzero(crosses[axis].any(axis=0))
            if len(particles):
                restless = np.nanmedian(step[:, particles], axis=0) > _RESTLESS * sizes[axis]
                crosses[axis, :, particles[restless]] = False
        frames, particles = np.nonzero(crosses.any(axis=0))
        if len(frames):
            goes_on = self._goes_on(frames, particles, crosses[:, frames, particles].T)
            goes_on &= goes_on.mean() > _MOST  # else some do by chance
            crosses[:, frames[~goes_on], particles[~goes_on]] = False
        return crosses

    def _goes_on(self, frames: np.ndarray, particles: np.ndarray, crossed: np.ndarray) -> np.ndarray:
        """(K,) whether the steps before and after K steps of particles are alike, and those across (K, D) axes outward.

        Of the first and the last step only one other is known.
        """
        final = len(self.step) - 1
        jump = self.step[frames, particles]
        before, after = (
            self.step[np.maximum(frames - 1, 0), particles],
            self.step[np.minimum(frames + 1, final), particles],
        )
        before = np.where((frames > 0)[:, None], before, after)
        after = np.where((frames < final)[:, None], after, before)
        expected = (before + after) / 2
        allowed = _GOES_ON * lengths(expected)[:, None] + _OUTWARD * self.spacing
        alike = (np.abs(before - after) < allowed).all(axis=1)
        straight = np.where(crossed, np.sign(jump) != np.sign(expected), np.abs(jump - expected) < allowed)
        return np.asarray(alike & straight.all(axis=1))

    @cached_property
    def wraps(self) -> np.ndarray:
        """(D,) number of steps across the ends of a periodic axis, in coordinates that wrap or do not."""
        counts = np.zeros(self.metadata.dim, dtype=int)
        for axis in np.flatnonzero(self.metadata.periodic):
            lower, upper = self.metadata.bounds[axis]
            x = self.position[..., axis].astype(np.float64)
            crosses = np.diff(np.floor((x - lower) / (upper - lower)), axis=0) != 0
            counts[axis] = ((crosses | (np.abs(np.diff(x, axis=0)) > (upper - lower) / 2)) & self.present[1:]).sum()
        return counts

    @cached_property
    def bounces(self) -> np.ndarray:
        """(D, 2) how often particles near the lower or upper end of a periodic axis turn back from it, or stop."""
        counts = np.zeros((self.metadata.dim, 2), dtype=int)
        for axis in np.flatnonzero(self.metadata.periodic):
            x, step = self.position[1:-1, :, axis], self.step[..., axis]
            for end, bound in enumerate(self.metadata.bounds[axis]):
                outward = step if end else -step
                near = np.abs(x - bound) < _NEAR * self.spacing
                counts[axis, end] = (near & (outward[:-1] > _OUTWARD * self.spacing) & (outward[1:] <= 0)).sum()
        return counts

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


def is_dense(position: np.ndarray, metadata: Metadata) -> bool:
    """Whether (N, D) particles keep their distance from one another, as in contact, and not as in flight."""
    there = position[~np.isnan(position[:, 0])]
    if len(there) < 2:
        return False
    tree = neighbour_tree(there, metadata)
    low, middle = np.quantile(tree.query(tree.data[:: -(-len(there) // _QUERIES)], k=2)[0][:, 1], (0.1, 0.5))
    return bool(low > _KEPT * middle)


def lengths(vectors: np.ndarray) -> np.ndarray:
    """(…) lengths of (…, D) vectors."""
    return np.asarray(np.sqrt(np.einsum("...d,...d->...", vectors, vectors)))


def spacing_of(position: np.ndarray, metadata: Metadata) -> float:
    """The spacing of a lattice as dense as (N, D) positions around most particles; 0 for fewer than two."""
    there = position[~np.isnan(position[:, 0])]
    if len(there) < 2:
        return 0.0
    number, dim = min(_NEIGHBOURS, len(there) - 1), there.shape[1]
    tree = neighbour_tree(there, metadata)
    distance = tree.query(tree.data[:: -(-len(there) // _QUERIES)], k=[number + 1])[0]
    ball = math.pi ** (dim / 2) / math.gamma(dim / 2 + 1)
    return float(np.median(distance) * (ball / number) ** (1 / dim))
