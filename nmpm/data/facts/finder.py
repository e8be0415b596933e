"""Collects facts about a dataset while its trajectories pass."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nmpm.data.array_checks import broken_frames, particles_far_away
from nmpm.data.facts.boundaries import Axis, Ends, boundary_fact, bounds_fact, domain_fact, find_axes
from nmpm.data.facts.fact import Fact, Facts
from nmpm.data.facts.free_fall import Track, find_gravity
from nmpm.data.facts.obstacles import TypeMotion, path_extents, prescribed_fact
from nmpm.data.facts.open_ends import unwrap
from nmpm.data.facts.sample import Samples
from nmpm.data.facts.timing import TimeSteps
from nmpm.data.facts.volume import find_particle_volume
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.gravity import Gravity
from nmpm.data.statistics import Extent
from nmpm.data.times import take_frames
from nmpm.errors import DataError
from nmpm.scene import Boundary

_SAMPLE_BYTES = 2**27


class FactFinder:
    """Finds the facts about a dataset in its trajectories, in bounded memory.

    Args:
        dim: Number of space dimensions.
        dt: Time between frames, where it is known; else it is found.
        obstacles: Types that are known to be obstacles, beside those that are found.
        boundary: The kind of boundary of each axis, where it is known; the domain depends on it.
        steps: Whether recorded times are numbers of a simulator's steps.
    """

    def __init__(
        self,
        dim: int,
        dt: float | None = None,
        obstacles: frozenset[int] = frozenset(),
        boundary: Sequence[Boundary] | None = None,
        steps: bool = False,
    ) -> None:
        self._steps = steps
        self.dim, self._dt, self._obstacles, self._boundary = dim, dt, obstacles, boundary
        self._extents: dict[int, Extent] = {}  # by type
        self._motion, self._samples, self._times = TypeMotion(), Samples(), TimeSteps()
        self._frames: set[int] = set()

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory, without frames and particles that are no data."""
        if (broken := broken_frames(trajectory.position)).any() and not broken.all():
            trajectory = take_frames(trajectory, np.flatnonzero(~broken))
        if (lost := particles_far_away(trajectory.position).any(axis=0)).any():
            kept = {name: trajectory.fields[name] for name in ("time",) if name in trajectory.fields}
            trajectory = Trajectory(trajectory.position[:, ~lost], trajectory.particle_type[~lost], {}, kept)
        position, types = trajectory.position, trajectory.particle_type
        self._frames.add(len(position))
        self._times.add(trajectory)
        low, high = np.fmin.reduce(position, axis=0), np.fmax.reduce(position, axis=0)
        present = np.isfinite(low).all(axis=1)
        if not present.any():
            return
        for kind in np.unique(types[present]).tolist():
            extent = self._extents.setdefault(kind, Extent(self.dim))
            extent.add(np.stack([low, high])[:, types == kind])
        self._motion.add(types, present, path_extents(position), mean_spacing(low[present], high[present]))
        self._samples.add(trajectory)

    @property
    def recorded_step(self) -> float | None:
        """The usual step of recorded times; None where there are none."""
        return self._times.usual

    def facts(self) -> Facts:
        """The facts; raises a DataError if no particle was ever there."""
        if not self._extents:
            raise DataError("no trajectory has a particle, so nothing can be found about them.")
        types, static = frozenset(self._extents), self._motion.static_fact()
        moving = types - static.value - self._obstacles or types - static.value
        volume = find_particle_volume(self._samples, moving)
        paths = {kind: self._paths(frozenset({kind})) for kind in moving}
        prescribed = prescribed_fact(paths, self._spacing(volume))
        materials = moving - prescribed.value
        if prescribed.value:
            volume = find_particle_volume(self._samples, materials)
        spacing, dt = self._spacing(volume), self._times.fact(tuple(self._samples), self._steps)
        beyond = self._extent(types - materials) if materials < types else None
        axes, openings = find_axes(self._paths(materials), self._extent(materials), beyond, spacing)
        bounds, boundary = bounds_fact(axes, spacing), boundary_fact(axes, openings)
        solid = [axis.solid for axis in axes] if materials < types else None
        return Facts(
            bounds=bounds,
            domain=domain_fact(bounds.value, self._boundary or boundary.value, solid, spacing),
            boundary=boundary,
            dt=dt,
            gravity=self._gravity(axes, materials, spacing, self._dt or dt.value),
            particle_types=self._motion.names_fact(prescribed.value),
            static_types=static,
            prescribed_types=prescribed,
            particle_volume=volume,
            sequence_length=self._length(),
            unmoving=self._motion.unmoving(materials),
        )

    def _paths(self, types: frozenset[int]) -> list[np.ndarray]:
        return [path for _, path in self._samples.paths(types)]

    def _spacing(self, volume: Fact[float | None]) -> float:
        """Typical distance of neighbours; where it is not known, a 64th of the longest side."""
        if volume.value:
            return math.pow(volume.value, 1 / self.dim)
        low, high = self._extent(frozenset(self._extents))
        return float(np.max(high - low)) / 64 or 1.0

    def _extent(self, types: frozenset[int]) -> Ends:
        """Lower and upper ends (D,) of all positions of some types."""
        extents = [extent for kind, extent in self._extents.items() if kind in types]
        lower, upper = (np.stack([getattr(each, side) for each in extents]) for side in ("lower", "upper"))
        return lower.min(axis=0), upper.max(axis=0)

    def _gravity(
        self, axes: Sequence[Axis], materials: frozenset[int], spacing: float, dt: float
    ) -> Fact[Gravity | None]:
        periods = np.array([axis.period.length if axis.period else 0.0 for axis in axes])
        paths = self._samples.paths(materials)
        tracks = [Track(unwrap(path, periods), sample.times(dt)) for sample, path in paths]
        closed = bool((periods > 0).all()) and materials == frozenset(self._extents)
        return find_gravity(tracks, spacing, dt, closed)

    def _length(self) -> Fact[int]:
        few, many = min(self._frames), max(self._frames)
        how = f"trajectories have {many if few == many else f'{few} to {many}'} frames."
        return Fact(many - 1, how, "measured")


def mean_spacing(low: np.ndarray, high: np.ndarray) -> float:
    """Edge of a cube with an equal part of the box around paths, from their lower and upper ends (N, D)."""
    sides = high.max(axis=0) - low.min(axis=0)
    longest = float(sides.max()) or 1.0
    return longest * math.pow(float(np.prod(np.maximum(sides / longest, 1e-3))) / len(low), 1 / len(sides))


def find_facts(split: Split, metadata: Metadata | None = None) -> Facts:
    """The facts in up to 128 MiB of positions of a split, in evenly spaced trajectories.

    The metadata state the time between frames, for gravity, and which types are obstacles; all else is found.

    Raises:
        DataError: if a trajectory cannot be read, or no particle is ever there.
    """
    stated = (metadata.dt, metadata.obstacle_types) if metadata else (None, frozenset[int]())
    finder = FactFinder(split.dim, *stated)
    for index in split.sample(_SAMPLE_BYTES):
        finder.add(split.read_with_fields(index))
    return finder.facts()
