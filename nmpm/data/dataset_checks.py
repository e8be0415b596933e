"""Checks the trajectories of a dataset one after the other, then compares them with one another and the metadata."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from nmpm._support.messages import span
from nmpm.data.boundaries import FEW_CROSSINGS, Openings, find_openings
from nmpm.data.findings import (
    Finding,
    Severity,
    check_dt,
    check_gravity,
    check_volume,
    correction,
    find_absences,
    find_broken_frames,
    find_disorder,
    find_jumps,
    find_missing_frames,
    find_moving_walls,
    find_noise,
    find_overlaps,
    find_particles_outside,
    find_repeated_frames,
    find_swapped_axes,
    find_time_faults,
    prescription,
)
from nmpm.data.format import Metadata, Split
from nmpm.data.scene_inference import WALL_LAYER
from nmpm.data.statistics import FINE_STEPS, Extent, never_moving, too_coarse
from nmpm.data.survey import RecordedMotion
from nmpm.data.volumes import VOLUME
from nmpm.errors import DataError

WINDOW = 18
"""Frames of a training window of the shipped configurations."""
_LEAST_PARTICLES = 32  # of which a spacing is compared


class DatasetChecks:
    """Collects findings about the trajectories that are added, and what is to be compared between them."""

    def __init__(self, metadata: Metadata) -> None:
        self.metadata = metadata
        self.trajectories = 0
        self._findings: list[Finding] = []  # about single trajectories
        self._recorded_steps: dict[str, float] = {}  # time steps by trajectory
        self._steps_of_fall: dict[str, float] = {}
        self._spacings: dict[str, tuple[float, float]] = {}  # least and largest of dense particles
        self._sparse: dict[str, tuple[float, float]] = {}  # of others
        self._extents: dict[str, np.ndarray] = {}
        self._stays: dict[str, np.ndarray] = {}
        self._extent, self._walls = Extent(metadata.dim), Extent(metadata.dim)  # of moving and static particles
        self.spacing, self._rounding = math.inf, 0.0
        self._frames, self._still, self._moving = Counter[int](), Counter[int](), Counter[int]()
        self._crossings, self._wraps = np.zeros((2, metadata.dim), dtype=int)
        self._openings: list[Openings] = []
        self._bounces = np.zeros((metadata.dim, 2), dtype=int)

    def add(self, motion: RecordedMotion) -> None:
        """Adds a trajectory with its fields."""
        trajectory = motion.trajectory
        self.trajectories += 1
        self._frames[len(trajectory.position)] += 1
        self._walls.add(trajectory.position[:, self.metadata.is_static(trajectory.particle_type)])
        if not motion.present.any():
            return
        for find in (find_broken_frames, find_time_faults, find_swapped_axes, find_disorder):
            if any(cause.severity == Severity.CONTRADICTION for cause in self._find(motion, find)):
                return  # everything else that would be found are its symptoms
        self._extent.add(motion.position)
        self._find(motion, find_particles_outside, find_moving_walls, find_overlaps, find_absences)
        continuous = len(motion.step) > 1 and motion.spacing
        if not continuous or not self._find(motion, find_jumps, find_repeated_frames, find_missing_frames):
            self._find(motion, find_noise)
        try:
            self._find(motion, check_dt, check_gravity, check_volume)
            self._measure(motion)
        except DataError:  # a wrong attribute, which is named elsewhere
            return

    def _find(self, motion: RecordedMotion, *finders: Callable[[RecordedMotion], Iterable[Finding]]) -> list[Finding]:
        """Adds what some functions find in a trajectory, and names it."""
        count = len(self._findings)
        for find in finders:
            self._findings += [replace(finding, where=motion.where) for finding in find(motion)]
        return self._findings[count:]

    def _measure(self, motion: RecordedMotion) -> None:
        if motion.recorded_step is not None:
            self._recorded_steps[motion.where] = motion.recorded_step
        elif motion.fall is not None and any(motion.fall):
            gravity = 1.0 if motion.stated_gravity is None else float(np.linalg.norm(motion.stated_gravity))
            if gravity:
                self._steps_of_fall[motion.where] = math.sqrt(float(np.linalg.norm(motion.fall)) / gravity)
        if len(motion.index) >= _LEAST_PARTICLES and motion.spacing:
            dense, spacings = motion.spacings
            # Material points at random places are never dense; where spacings differ then, particles are in flight.
            steady = spacings and (dense or max(spacings) < _RESOLUTIONS * min(spacings))
            if steady and VOLUME not in motion.trajectory.attributes:
                (self._spacings if dense else self._sparse)[motion.where] = min(spacings), max(spacings)
            self._extents[motion.where], self._stays[motion.where] = motion.extent, motion.stays
        self.spacing = min(self.spacing, motion.spacing or math.inf)
        self._rounding = max(self._rounding, motion.rounding)
        types = motion.trajectory.particle_type[motion.index]
        still = never_moving(motion.position, motion.spacing)
        self._still.update(types[still].tolist())
        self._moving.update(types[~still].tolist())
        self._crossings += motion.crossings.sum(axis=(1, 2))
        self._wraps += motion.wraps
        if not motion.present.all():
            self._openings.append(find_openings([motion.position], *motion.extent.T))
        self._bounces += motion.bounces

    def result(self) -> list[Finding]:
        """Findings about all trajectories together, then about single ones."""
        mixed = [
            *compare_time_steps(self._recorded_steps, "recorded time step"),
            *compare_time_steps(self._steps_of_fall, "time step, or gravity,"),
        ]
        kinds = ("dt",) if mixed else ()  # that of some trajectories is right
        return [*mixed, *self._compare(), *(each for each in self._findings if each.kind not in kinds)]

    def _compare(self) -> list[Finding]:
        findings = [*self._check_precision(), *self._check_boundary(), *self._check_types()]
        findings += compare_spacings(self._spacings or self._sparse)
        findings += compare_domains(self._extents, self._stays, self.spacing)
        if np.isfinite(self._extent.lower).all():
            findings += compare_bounds(self._extent, self._walls, self.metadata)
        return [*findings, *self._check_lengths()]

    def _check_precision(self) -> Iterator[Finding]:
        """Yields a finding if float32 resolves coordinates too coarsely for the spacing of particles."""
        for sentence in too_coarse(self.spacing, self._rounding, self._extent.lower):
            factor = FINE_STEPS * self._rounding / self.spacing
            yield Finding("float32", Severity.CONTRADICTION, sentence, factor=factor)

    def _check_boundary(self) -> Iterator[Finding]:
        """Yields findings about axes whose stated boundary is not as particles show it.

        They cross walls, from one end of all positions to the other; their tracks end for good near the ends of an axis
        whose boundary lets nothing out; or they never cross the ends of a periodic axis, but turn back from them. Where
        static particles are at these ends, a model may do without the wall.
        """
        metadata, kinds, walls = self.metadata, np.asarray(self.metadata.boundary), self._walls
        near = [opening for opening in self._openings if not opening.anywhere]
        ends = np.array([sum(each.ends for each in near if axis in each.axes) for axis in range(metadata.dim)])
        opened = (ends >= FEW_CROSSINGS) & (kinds != "open")
        closed = (self._wraps == 0) & (self._bounces.sum(axis=1) >= _FEW_BOUNCES)
        lower, upper = np.asarray(metadata.bounds).T
        solid = (walls.lower < lower + _SOLID * self.spacing) | (walls.upper > upper - _SOLID * self.spacing)
        for axes, kind, stated, motion in (
            (
                (self._crossings >= FEW_CROSSINGS) & ~np.asarray(metadata.periodic),
                "periodic",
                "not periodic",
                f"{int(self._crossings.sum())} times a particle leaves at one end and is at the other.",
            ),
            (
                opened,
                "open",
                kinds[int(np.argmax(opened))],
                f"{int(ends.max())} particles are seen last near its ends, and then no more: they leave, or were lost.",
            ),
            (
                closed,
                "wall",
                "periodic",
                f"nobody ever crosses the ends, and {int(self._bounces.sum())} times a particle turns back there.",
            ),
        ):
            if axes.any():
                harmless = kind == "wall" and solid[axes].all()
                mend = correction(f"--boundary {','.join(np.where(axes, kind, kinds))}")
                yield Finding(
                    "boundary",
                    Severity.ODDITY if harmless else Severity.CONTRADICTION,
                    f"along {_axes(axes)} it is stated as {stated}, but {motion} {mend}",
                )

    def _check_types(self) -> Iterator[Finding]:
        """Yields findings if particles of a material never move, or those of a wall do."""
        names, still, total = self.metadata.particle_types, self._still, self._still + self._moving
        resting = [i for i in sorted(still) if still[i] >= _STILL_SHARE * total[i] and still[i] > 1]
        if resting and any(self._moving.values()):
            many = ", ".join(f"{still[i]} of {total[i]} particles of type {i}, {names[i]}," for i in resting)
            whole = [i for i in resting if still[i] == total[i]]
            ids = ",".join(map(str, sorted(self.metadata.static_types | set(whole))))
            mend = correction(f"--static {ids}") if whole else "Give them a type of their own, which is static."
            yield Finding(
                "still particles",
                Severity.CONTRADICTION,
                f"{many} never move, while other particles do. Are they walls? {mend}",
                factor=max(still[i] / total[i] for i in resting),
            )
        moving = (i for i, count in sorted(self._moving.items()) if count)
        walls = [i for i in moving if any(word in names[i].lower() for word in _WALL_NAMES)]
        if walls:
            yield Finding(
                "walls that are predicted",
                Severity.CONTRADICTION,
                f"type {', '.join(f'{i}, {names[i]},' for i in walls)} moves and counts as a material."
                f" {prescription(walls)}",
            )

    def _check_lengths(self) -> Iterator[Finding]:
        """Yields a finding if trajectories have fewer frames than a training window; a note if all have."""
        frames = self._frames
        if short := sum(count for number, count in frames.items() if number < WINDOW):
            severity, left = Severity.NOTE, ""
            if short < frames.total():
                severity, left = Severity.ODDITY, ": a training leaves them out"
            yield Finding(
                "short trajectories",
                severity,
                f"{short} of {frames.total()} trajectories have fewer than {WINDOW} frames (the shortest"
                f" {min(frames)}), as training windows of the shipped configurations have{left}.",
                factor=short / frames.total(),
            )


_MIXED = 1.1  # factor between time steps
_RESOLUTIONS = 1.3  # factor between spacings of trajectories, or of a steady one
_TOO_LARGE, _FAR_TOO_LARGE = 3.0, 10.0  # times the extent of all positions
_FEW_BOUNCES = 5
_SOLID = 2.0  # spacings from an end
_STILL_SHARE = 0.01  # of the particles of a type
_SAME_END = 2.0  # spacings between the ends of trajectories that end at the same wall
_STAYS = 0.3  # of the frames: particles are at a wall
_BEYOND = 0.1  # of the extent, beyond such a wall
_WALL_NAMES = ("wall", "boundary", "static", "obstacle", "fixed", "frozen")


def compare_time_steps(steps: Mapping[str, float], what: str) -> Iterator[Finding]:
    """Yields a finding if time steps, by trajectory and in any unit, differ; `what` names them."""
    if not steps:
        return
    values = np.array(list(steps.values()))
    usual = float(np.median(values))
    ratios = values / usual
    odd = int(np.argmax(np.abs(np.log(ratios))))
    if 1 / _MIXED < ratios[odd] < _MIXED:
        return
    many = int((np.abs(np.log(ratios)) > np.log(_MIXED)).sum())
    yield Finding(
        "mixed time steps",
        Severity.CONTRADICTION,
        f"the {what} of {many} of {len(values)} trajectories differs from the others', e.g. in {list(steps)[odd]} it"
        f" is {ratios[odd]:.3g} times as long. Make a dataset of each, or leave frames out.",
        factor=float(ratios[odd]),
    )


def compare_spacings(spacings: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yields a finding if particles' least and largest spacings both differ between trajectories."""
    if not spacings:
        return
    names, values = list(spacings), np.array(list(spacings.values()))
    fine, coarse = int(np.argmin(values[:, 0])), int(np.argmax(values[:, 0]))
    factor = float((values[coarse] / values[fine]).min())
    if factor > _RESOLUTIONS:
        yield Finding(
            "different resolution",
            Severity.CONTRADICTION,
            f"particles are {values[coarse, 0]:.3g} apart in {names[coarse]} and {values[fine, 0]:.3g} in"
            f" {names[fine]}, {factor:.3g} times less. Make a dataset of each resolution.",
            factor=factor,
        )


def compare_domains(
    extents: Mapping[str, np.ndarray], stays: Mapping[str, np.ndarray], spacing: float
) -> Iterator[Finding]:
    """Yields a finding if particles of a trajectory stay far beyond a place at which those of most others end.

    By trajectory: (D, 2) lowest and highest coordinates, and the share of frames in which a particle is near these.
    """
    if len(extents) < 3:
        return
    names, values = list(extents), np.array(list(extents.values()))
    near = np.array(list(stays.values())) > _STAYS
    sizes = np.median(values[..., 1] - values[..., 0], axis=0)
    for axis, end in np.ndindex(values.shape[1:]):
        outward, staying = values[:, axis, end] * (1 if end else -1), near[:, axis, end]
        wall = float(np.median(outward))
        same = (np.abs(outward - wall) < _SAME_END * spacing) & staying
        beyond = staying & (outward - wall > max(_BEYOND * sizes[axis], 2 * _SAME_END * spacing))
        if 2 * same.sum() > len(names) and beyond.any():
            odd = int(np.argmax(np.where(beyond, outward, -np.inf)))
            yield Finding(
                "different domains",
                Severity.CONTRADICTION,
                f"in {int(beyond.sum())} of {len(names)} trajectories particles stay at {'xyz'[axis]} ="
                f" {values[odd, axis, end]:.4g}, e.g. in {names[odd]}; in others they end at"
                f" {wall if end else -wall:.4g}. Make a dataset of each domain.",
                factor=float((values[odd, axis, 1] - values[odd, axis, 0]) / sizes[axis]),
            )
            return


def compare_bounds(extent: Extent, walls: Extent, metadata: Metadata) -> Iterator[Finding]:
    """Yields findings if particles move beyond the stated bounds, or these are far larger than where particles are."""
    lower, upper = np.asarray(metadata.bounds).T
    size, walled = upper - lower, np.asarray(metadata.boundary) == "wall"
    seen = np.maximum(extent.upper, walls.upper) - np.minimum(extent.lower, walls.lower)
    beyond = np.maximum(lower - extent.lower, extent.upper - upper) / size * walled
    larger = np.where(walled, size / np.maximum(seen, 1e-12 * size), 0.0)
    axis = int(np.argmax(beyond))
    if beyond[axis] > 0:
        serious = beyond[axis] > WALL_LAYER
        ends = ",".join(f"{low:.4g}:{high:.4g}" for low, high in extent.intervals)
        mend = f" {correction(f'--bounds={ends}')}" if serious else " The domain contains them."
        yield Finding(
            "bounds",
            Severity.CONTRADICTION if serious else Severity.NOTE,
            f"along {_axes(beyond > 0)} positions reach beyond the stated ones, by up to {beyond[axis]:.2%} of their"
            f" size: {'xyz'[axis]} is {span(extent.intervals[axis])}, stated {span(metadata.bounds[axis])}.{mend}",
            factor=float(seen[axis] / size[axis]),
        )
    axis = int(np.argmax(larger))
    if larger[axis] > _TOO_LARGE:
        yield Finding(
            "far bounds",
            Severity.CONTRADICTION if larger[axis] > _FAR_TOO_LARGE else Severity.ODDITY,
            f"along {_axes(larger > _TOO_LARGE)} they are up to {larger[axis]:.3g} times as large as where particles"
            f" ever are: {'xyz'[axis]} is {span(extent.intervals[axis])}, stated {span(metadata.bounds[axis])}.",
            factor=float(larger[axis]),
        )


def _axes(mask: np.ndarray) -> str:
    return ", ".join("xyz"[axis] for axis in np.flatnonzero(mask))


_PARTICLES = 32  # that move, and as many that do not
_SAME_RUN = 0.3  # spacings that a particle of two runs may be apart
_SAME_START = 1e-3


@dataclass(frozen=True)
class _Run:
    """Positions of some particles in the first two frames (2, K, D) and in the last one (K, D), and attributes."""

    split: str
    name: str
    start: np.ndarray
    end: np.ndarray
    frames: int
    attributes: dict[str, Any]


_Pairs = dict[tuple[str, str], list[tuple[_Run, _Run]]]


def find_shared_runs(
    splits: Mapping[str, Split], metadata: Metadata, spacing: float, most: int = 500
) -> Iterator[Finding]:
    """Yields findings about trajectories of different splits, or of one, that are the same or start the same.

    Compared are some particles in the first two frames and in the last one, of so many trajectories of each split.
    """
    groups: dict[tuple[int, ...], list[_Run]] = {}
    for run, particles in _read_runs(splits, metadata, most):
        groups.setdefault((particles, *run.start.shape), []).append(run)
    same, starts = _Pairs(), _Pairs()
    for runs in groups.values():
        tree = cKDTree(np.stack([run.start.ravel() for run in runs]))
        for i, j in sorted(tree.query_pairs(_SAME_RUN * spacing, p=np.inf)):
            one, other = runs[i], runs[j]
            if one.frames == other.frames and np.abs(one.end - other.end).max() <= _SAME_RUN * spacing:
                same.setdefault((one.split, other.split), []).append((one, other))
            elif np.abs(one.start - other.start).max() <= _SAME_START * spacing and one.attributes == other.attributes:
                starts.setdefault((one.split, other.split), []).append((one, other))
    yield from _describe(same, splits, "shared trajectories", "are the same")
    yield from _describe(starts, splits, "shared starts", "have the same first two frames")


def _read_runs(splits: Mapping[str, Split], metadata: Metadata, most: int) -> Iterator[tuple[_Run, int]]:
    for name, split in splits.items():
        for index in split.spread(most):
            try:
                start = split.read(index, 0, 2)
                end = split.read(index, split.frames(index) - 1).position[0]
            except DataError:
                continue
            moves = metadata.is_moving(start.particle_type)
            picked = np.concatenate([_evenly(np.flatnonzero(moves)), _evenly(np.flatnonzero(~moves))])
            attributes = {key: np.asarray(value).tolist() for key, value in start.attributes.items() if key != "seed"}
            frames = split.frames(index)
            positions = np.nan_to_num(start.position[:, picked]), np.nan_to_num(end[picked])
            yield _Run(name, split.names[index], *positions, frames, attributes), len(moves)


def _evenly(indices: np.ndarray) -> np.ndarray:
    return indices[:: max(1, -(-len(indices) // _PARTICLES))]


def _describe(pairs: _Pairs, splits: Mapping[str, Split], kind: str, what: str) -> Iterator[Finding]:
    """Yields a finding for pairs of different splits, a contradiction if they are the same; else for those of one."""
    across = {names: found for names, found in pairs.items() if names[0] != names[1]}
    for (first, second), found in list((across or pairs).items())[:1]:
        one, other = found[0]
        count = len({b.name for _, b in found})
        whole = f"all {count}" if count == len(splits[second]) > 1 else f"{count} of {len(splits[second])}"
        leak = f"{second} says nothing about new scenes" if across else "they count twice"
        yield Finding(
            kind,
            Severity.CONTRADICTION if across and "are the same" in what else Severity.ODDITY,
            f"{first} and {second}: {whole} trajectories {what}, e.g. {one.split} {one.name} and {other.split}"
            f" {other.name}: {leak}.",
            factor=count / len(splits[second]),
        )
