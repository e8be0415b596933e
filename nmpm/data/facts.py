"""Facts about a dataset that are found in its trajectories: bounds, boundaries, time step, gravity, types, volume.

    finder = FactFinder(dim=2)
    for trajectory in trajectories:
        finder.add(trajectory)
    metadata = finder.facts().complete(metadata, unknown)

Positions are read once, one trajectory at a time; a few small samples are kept. Particles that are absent (NaN) count
nowhere.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nmpm.data.array_checks import broken_frames, particles_far_away
from nmpm.data.boundaries import Ends, boundary_fact, bounds_fact, domain_fact, find_axes, unwrap
from nmpm.data.format import Split, Trajectory
from nmpm.data.gravity import Track, find_gravity
from nmpm.data.metadata import FOUND, Fact, Metadata
from nmpm.data.samples import Sample, take_sample
from nmpm.data.spacing import find_particle_volume, mean_spacing
from nmpm.data.statistics import AT_REST, Extent, evenly, never_moving, path_extents
from nmpm.data.times import TimeSteps, take_frames
from nmpm.errors import DataError
from nmpm.scene import Boundary, Interval


@dataclass(frozen=True)
class Unmoving:
    """Particles of moving types that never move in trajectories where others do."""

    trajectory: int  # of the first of them
    particle: int
    count: int  # of all


@dataclass(frozen=True)
class FoundFacts:
    """Facts about a dataset, named as the fields of `Metadata`; lengths and times in the file's units."""

    bounds: Fact[tuple[Interval, ...]]
    domain: Fact[tuple[Interval, ...]]  # what a grid should cover
    boundary: Fact[tuple[Boundary, ...]]
    dt: Fact[float]
    gravity: Fact[tuple[float, ...] | None]  # None where it is not known
    particle_types: Fact[dict[int, str]]
    static_types: Fact[frozenset[int]]
    prescribed_types: Fact[frozenset[int]]
    particle_volume: Fact[float | None]  # None where it is not known
    sequence_length: Fact[int]
    unmoving: Unmoving | None = None  # particles of materials that never move where others do

    def complete(self, metadata: Metadata, unknown: Collection[str]) -> Metadata:
        """The metadata with the `unknown` fields replaced by these facts, and notes on them under the key `found`.

        Types that the metadata name or declare static remain so. With the static types, the prescribed ones are found;
        with the bounds, the domain.
        """
        names = {*unknown, *({"prescribed_types"} if "static_types" in unknown else ())}
        if "bounds" in unknown and metadata.domain is None:
            names.add("domain")
        unnamed = sorted(set(self.particle_types.value) - set(metadata.particle_types))
        if not unnamed:
            names.discard("particle_types")
        if metadata.prescribed_types and self.prescribed_types.value <= metadata.prescribed_types:
            names.discard("prescribed_types")
        facts: dict[str, Fact[Any]] = {name: fact for name, fact in vars(self).items() if name in names}
        if "particle_types" in facts and metadata.particle_types:
            how = f"those of type {', '.join(map(str, unnamed))} {self.particle_types.how}"
            facts["particle_types"] = replace(self.particle_types, how=how)
        values = {name: fact.value for name, fact in facts.items()}
        if "particle_types" in values:
            values["particle_types"] = values["particle_types"] | metadata.particle_types
        for name in {"static_types", "prescribed_types"} & set(values):
            values[name] |= getattr(metadata, name)
        notes = {name: str(fact) for name, fact in facts.items()}
        return replace(metadata, **values, extra=metadata.extra | {FOUND: notes})


_TRAJECTORIES = 16
_SLOW = 1e-4  # of the spacing: a smaller acceleration of what falls is none
_RIGID = 1e-2  # of the spacing, by which particles of a rigid body may be off
_SAME = 0.1  # of the spacing, by which motions of one program may differ
_START = 6  # frames in which free bodies fall as others do
_RIGID_FRAMES, _RIGID_PARTICLES = 12, 200  # in which a rigid motion is fitted


class TypeMotion:
    """Accumulates how far the particles of each type move."""

    def __init__(self) -> None:
        self._types: dict[int, int] = {}  # trajectories in which each type occurs
        self._range: dict[int, float] = {}  # in mean spacings
        self._unmoving: dict[int, Unmoving] = {}
        self._count = 0

    def add(self, types: np.ndarray, present: np.ndarray, position: np.ndarray, spacing: float) -> None:
        """Adds a trajectory (T, N, D) of particles at a mean distance, their types, and whether each is ever there."""
        reach, still = path_extents(position), never_moving(position, spacing)
        for kind in np.unique(types[present]).tolist():
            farthest = float(np.fmax.reduce(reach[types == kind], initial=0.0)) / spacing
            self._types[kind] = self._types.get(kind, 0) + 1
            self._range[kind] = max(self._range.get(kind, 0.0), farthest)
            if len(indices := np.flatnonzero(still & (types == kind))):
                first = self._unmoving.get(kind, Unmoving(self._count, int(indices[0]), 0))
                self._unmoving[kind] = replace(first, count=first.count + len(indices))
        self._count += 1

    @property
    def static(self) -> frozenset[int]:
        """Types that never move while others do."""
        still = frozenset(kind for kind, reach in self._range.items() if reach < AT_REST)
        return still if len(still) < len(self._range) else frozenset()

    def unmoving(self, materials: frozenset[int]) -> Unmoving | None:
        """Particles of materials that never move, if there are any."""
        each = [self._unmoving[kind] for kind in sorted(materials) if kind in self._unmoving]
        return replace(each[0], count=sum(one.count for one in each)) if each else None

    def static_fact(self) -> Fact[frozenset[int]]:
        """The types that never move."""
        static = self.static
        if not static:
            return Fact(static, "every type moves.", "measured")
        names = ", ".join(map(str, sorted(static)))
        least = min(self._range[kind] for kind in self._range if kind not in static)
        how = f"the particles of type {names} never move, those of other types move by {least:.3g} spacings or more."
        return Fact(static, how, "measured")

    def names_fact(self, prescribed: frozenset[int]) -> Fact[dict[int, str]]:
        """Names of types: `boundary`, `moving boundary`, `particles`; with the id where several would have the name."""
        kinds = {i: "moving boundary" if i in prescribed else "" for i in sorted(self._types)}
        kinds |= dict.fromkeys(sorted(self.static), "boundary")
        counts = Counter(kinds.values())
        numbered = {i: f"{kind} {i}" if kind else f"type{i}" for i, kind in kinds.items()}
        names = {i: kind or "particles" if counts[kind] == 1 else numbered[i] for i, kind in kinds.items()}
        rare = [f"{kind} in {number}" for kind, number in self._types.items() if number < self._count]
        how = f"by their ids{f'; of {self._count} trajectories type ' if rare else ''}{', '.join(rare)}."
        return Fact(names, how, "guessed")


def prescribed_fact(positions: Mapping[int, Sequence[np.ndarray]], spacing: float) -> Fact[frozenset[int]]:
    """The types whose particles move as one rigid body by a program, in positions (F, N, D) of each trajectory by type.

    A program is the same in all trajectories, or goes on at a constant speed; a body that falls as others do is free.
    None is prescribed if all types are rigid: a rigid body alone is what is to be predicted.
    """
    rigid = {kind for kind, paths in positions.items() if paths and all(_is_rigid(each, spacing) for each in paths)}
    if not rigid or len(rigid) == len(positions):
        return Fact(frozenset(), "no type moves as a rigid body among others that do not.", "measured")
    others = [path for kind, paths in positions.items() if kind not in rigid for path in paths]
    prescribed = frozenset(kind for kind in rigid if _has_program(positions[kind], others, spacing))
    free = ", ".join(map(str, sorted(rigid - prescribed)))
    names = ", ".join(map(str, sorted(prescribed)))
    programs = f"the particles of type {names} turn and shift as one, those of others do not"
    bodies = f"type {free} is rigid, and taken for free bodies: it falls, or differs between trajectories"
    how = "; ".join([programs] * bool(names) + [bodies] * bool(free))
    return Fact(prescribed, f"{how}.", "likely")


def _has_program(paths: Sequence[np.ndarray], others: Sequence[np.ndarray], spacing: float) -> bool:
    """Whether bodies (F, N, D) move as others never would: see `prescribed_fact`."""
    centres = [np.nanmean(path, axis=1) for path in paths]
    shifts = [centre - centre[0] for centre in centres]
    length = min(map(len, shifts))
    same = all(np.abs(shift[:length] - shifts[0][:length]).max() < _SAME * spacing for shift in shifts)
    steady = all(np.abs(np.diff(centre, 2, axis=0)).max(initial=0.0) < _RIGID * spacing for centre in centres)
    if len(centres) > 1 and not (same or steady):
        return False
    start = np.mean([np.diff(centre[:_START], 2, axis=0).mean(axis=0) for centre in centres], axis=0)
    falls = np.concatenate([np.diff(other[:_START], 2, axis=0).reshape(-1, len(start)) for other in others])
    falls = falls[np.isfinite(falls).all(axis=1)]
    if not len(falls):
        return True
    fall = np.median(falls, axis=0)
    size = float(np.linalg.norm(fall))
    return size < _SLOW * spacing or float(np.linalg.norm(start - fall)) > _SAME * size


def _is_rigid(position: np.ndarray, spacing: float) -> bool:
    """Whether particles (F, N, D) are those of the first frame, turned and shifted."""
    from scipy.linalg import orthogonal_procrustes  # which loading a model need not wait for

    points = position[:, np.isfinite(position).all(axis=(0, 2))][:, :_RIGID_PARTICLES]
    if points.shape[1] <= points.shape[2] + 1 or len(points) < _START:
        return False  # any motion of few particles in few frames is almost rigid
    rounding = 8 * float(np.finfo(np.float32).eps) * float(np.abs(points).max())
    frames = evenly(len(points), _RIGID_FRAMES)[1:]
    centred = points - points.mean(axis=1, keepdims=True)
    turned = [centred[0] @ orthogonal_procrustes(centred[0], centred[frame])[0] for frame in frames]
    return bool(np.abs(turned - centred[frames]).max() < _RIGID * spacing + rounding)


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
        self._motion, self._times = TypeMotion(), TimeSteps()
        self._samples: list[Sample] = []  # of evenly spaced trajectories
        self._seen, self._stride = 0, 1
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
        self._motion.add(types, present, position, mean_spacing(low[present], high[present]))
        if self._seen % self._stride == 0:
            self._samples.append(take_sample(trajectory))
        self._seen += 1
        if len(self._samples) > _TRAJECTORIES:
            self._samples, self._stride = self._samples[::2], 2 * self._stride

    @property
    def recorded_step(self) -> float | None:
        """The usual step of recorded times; None where there are none."""
        return self._times.usual

    def facts(self) -> FoundFacts:
        """The facts; raises a DataError if no particle was ever there."""
        if not self._extents:
            raise DataError("no trajectory has a particle, so nothing can be found about them.")
        types, static = frozenset(self._extents), self._motion.static_fact()
        moving = types - static.value - self._obstacles or types - static.value
        volume = find_particle_volume(self._samples, moving)
        paths = {kind: [path for _, path in self._paths(frozenset({kind}))] for kind in moving}
        prescribed = prescribed_fact(paths, self._spacing(volume))
        materials = moving - prescribed.value
        if prescribed.value:
            volume = find_particle_volume(self._samples, materials)
        spacing, dt = self._spacing(volume), self._times.fact(self._samples, self._steps)
        beyond = self._extent(types - materials) if materials < types else None
        tracks = self._paths(materials)
        axes, openings = find_axes([path for _, path in tracks], self._extent(materials), beyond, spacing)
        bounds, boundary = bounds_fact(axes, spacing), boundary_fact(axes, openings)
        solid = [axis.solid for axis in axes] if materials < types else None
        periods, between = np.array([axis.period.length if axis.period else 0.0 for axis in axes]), self._dt or dt.value
        flights = [Track(unwrap(path, periods), sample.times(between)) for sample, path in tracks]
        few, many = min(self._frames), max(self._frames)
        frames = f"{many}" if few == many else f"{few} to {many}"
        return FoundFacts(
            bounds=bounds,
            domain=domain_fact(bounds.value, self._boundary or boundary.value, solid, spacing),
            boundary=boundary,
            dt=dt,
            gravity=find_gravity(flights, spacing, between, closed=bool((periods > 0).all()) and materials == types),
            particle_types=self._motion.names_fact(prescribed.value),
            static_types=static,
            prescribed_types=prescribed,
            particle_volume=volume,
            sequence_length=Fact(many - 1, f"trajectories have {frames} frames.", "measured"),
            unmoving=self._motion.unmoving(materials),
        )

    def _paths(self, types: frozenset[int]) -> list[tuple[Sample, np.ndarray]]:
        """The samples in which particles of some types occur, and the positions (F, N, D) of these."""
        paths = [(sample, sample.of(types)) for sample in self._samples]
        return [(sample, path) for sample, path in paths if path.shape[1]]

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


def find_facts(split: Split, metadata: Metadata | None = None) -> FoundFacts:
    """The facts in up to 128 MiB of positions of a split, in evenly spaced trajectories.

    The metadata state the time between frames, for gravity, and which types are obstacles; all else is found.

    Raises:
        DataError: if a trajectory cannot be read, or no particle is ever there.
    """
    stated = (metadata.dt, metadata.obstacle_types) if metadata else (None, frozenset[int]())
    finder = FactFinder(split.dim, *stated)
    for index in split.sample():
        finder.add(split.read_with_fields(index))
    return finder.facts()
