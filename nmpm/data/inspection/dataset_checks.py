"""Checks all trajectories of a dataset, one at a time, and compares them with one another and with the metadata."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.data.inspection.irregular_motion import find_irregular_motion
from nmpm.data.inspection.motion import Motion
from nmpm.data.inspection.particles import find_odd_particles, never_moving
from nmpm.data.inspection.stated import check_stated, correction, free_fall, recorded_dt, too
from nmpm.data.statistics import Extent

_MIXED = 1.1  # factor between time steps
_RESOLUTIONS = 1.3  # factor between spacings
_LEAST_PARTICLES = 32
_FINE = 1000.0  # roundings of a coordinate to a spacing
_WALL_LAYER = 0.025  # of the bounds: beyond that, they are not the walls
_TOO_LARGE = 3.0  # times the extent of the positions
_AT_THE_END = 1.0  # spacings from the end of an axis
_WINDOW = 18  # frames of a training window of the shipped configurations
_WALL_NAMES = ("wall", "boundary", "static", "obstacle", "fixed", "frozen")


@dataclass
class DatasetChecks:
    """Findings about the trajectories that were added; those of the dataset as a whole come at the end."""

    metadata: Metadata
    findings: list[Finding] = field(default_factory=list)
    trajectories: int = 0
