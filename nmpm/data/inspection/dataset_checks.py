"""Checks the trajectories of a dataset one after the other, then compares them with one another and the metadata."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from nmpm.data.facts.obstacles import never_moving, path_extents
from nmpm.data.facts.open_ends import Openings, find_openings
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.inspection import comparisons
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.irregular_motion import (
    find_broken_frames,
    find_disorder,
    find_irregular_motion,
    find_noise,
    find_swapped_axes,
)
from nmpm.data.inspection.motion import Motion, is_dense, spacing_of
from nmpm.data.inspection.stated import check_stated, find_odd_particles, find_time_faults, free_fall
from nmpm.data.statistics import Extent
from nmpm.data.times import recorded_step
from nmpm.data.volumes import VOLUME
from nmpm.errors import DataError

WINDOW = 18
"""Frames of a training window of the shipped configurations."""
_SPACING_FRAMES = 5  # in which the spacing of a trajectory is measured
_STEADY = 1.3  # factor between spacings of a trajectory
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

    def add(self, trajectory: Trajectory, where: str) -> None:
        """Adds a trajectory with its fields, called `where`."""
        motion = Motion(trajectory, self.metadata, where)
        self.trajectories += 1
        self._frames[len(trajectory.position)] += 1
        self._walls.add(trajectory.position[:, self.metadata.is_static(trajectory.particle_type)])
        if not motion.present.any():
            return
        for find in (find_broken_frames, find_time_faults, find_swapped_axes, find_disorder):
            causes = list(find(motion))
            self._findings += causes
            if any(cause.severity == Severity.CONTRADICTION for cause in causes):
                return  # everything else that would be found are its symptoms
        self._extent.add(motion.position)
        irregular = list(find_irregular_motion(motion))
        self._findings += [*find_odd_particles(motion), *irregular, *(() if irregular else find_noise(motion))]
        try:
            self._findings += check_stated(motion)
            self._measure(motion)
        except DataError:  # a wrong attribute, which is named elsewhere
            return

    def _measure(self, motion: Motion) -> None:
        if (recorded := recorded_step(motion.trajectory)) is not None:
            self._recorded_steps[motion.where] = recorded
        elif (dt := _dt_of_fall(motion)) is not None:
            self._steps_of_fall[motion.where] = dt
        if len(motion.index) >= _LEAST_PARTICLES and motion.spacing:
            if VOLUME not in motion.trajectory.attributes and (found := _spacings(motion)):
                dense, spacings = found
                (self._spacings if dense else self._sparse)[motion.where] = spacings
            self._extents[motion.where], self._stays[motion.where] = motion.extent, motion.stays
        self.spacing = min(self.spacing, motion.spacing or math.inf)
        self._rounding = max(self._rounding, motion.rounding)
        types = motion.trajectory.particle_type[motion.index]
        still = never_moving(path_extents(motion.position), motion.spacing)
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
            *comparisons.compare_time_steps(self._recorded_steps, "recorded time step"),
            *comparisons.compare_time_steps(self._steps_of_fall, "time step, or gravity,"),
        ]
        kinds = ("dt",) if mixed else ()  # that of some trajectories is right
        return [*mixed, *self._compare(), *(each for each in self._findings if each.kind not in kinds)]

    def _compare(self) -> list[Finding]:
        findings: list[Finding] = []
        findings += comparisons.check_precision(self.spacing, self._rounding, self._extent)
        findings += comparisons.check_crossings(self.metadata, self._crossings)
        findings += comparisons.check_openings(self.metadata, self._openings)
        findings += comparisons.check_periods(self.metadata, self._wraps, self._bounces, self._walls, self.spacing)
        findings += comparisons.check_types(self.metadata, self._still, self._moving)
        findings += comparisons.compare_spacings(self._spacings or self._sparse)
        findings += comparisons.compare_domains(self._extents, self._stays, self.spacing)
        if np.isfinite(self._extent.lower).all():
            findings += comparisons.compare_bounds(self._extent, self._walls, self.metadata)
        findings += comparisons.check_lengths(self._frames, WINDOW)
        return findings


def _spacings(motion: Motion) -> tuple[bool, tuple[float, float]] | None:
    """Whether particles are dense in some frames, and the least and the largest spacing in these.

    Where they never are, as material points that are drawn at random, all frames count; None if spacings differ then:
    particles in flight.
    """
    frames = np.unique(np.linspace(0, len(motion.position) - 1, _SPACING_FRAMES).astype(int))
    dense = [frame for frame in frames if is_dense(motion.position[frame], motion.metadata)]
    spacings = [spacing_of(motion.position[frame], motion.metadata) for frame in dense or frames]
    spacings = [spacing for spacing in spacings if spacing]
    if not spacings or (not dense and max(spacings) > _STEADY * min(spacings)):
        return None
    return bool(dense), (min(spacings), max(spacings))


def _dt_of_fall(motion: Motion) -> float | None:
    """The time step by which particles fall freely by the stated gravity, or by 1 where none is stated."""
    fall = free_fall(motion)
    if fall is None or not any(fall):
        return None
    stated = trajectory_gravity(motion.trajectory.attributes, motion.metadata, motion.where)
    gravity = float(np.linalg.norm(stated)) if stated is not None else 1.0
    return math.sqrt(float(np.linalg.norm(fall)) / gravity) if gravity else None
