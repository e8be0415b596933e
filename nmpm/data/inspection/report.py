"""The results of an inspection."""

from __future__ import annotations

from dataclasses import dataclass

from nmpm.scene import Interval

Range = tuple[int, int]
"""Smallest and largest value."""


@dataclass(frozen=True)
class SplitFacts:
    """Facts about one split.

    Args:
        trajectories: Number of trajectories in the file.
        inspected: Number of those that were read.
        frames: Frames of a trajectory.
        particles: Moving particles of a trajectory.
        static: Static particles of a trajectory.
    """

    trajectories: int
    inspected: int
    frames: Range
    particles: Range
    static: Range


@dataclass(frozen=True)
class GridFacts:
    """Facts about the data on one grid.

    Args:
        cells: Cells along the longest side.
        shape: Cells along each axis.
        per_cell: Particles per occupied cell, median over frames.
        median_speed: Median speed of the moving particles, in cells per frame.
        high_speed: 99.9% quantile of their speeds, in cells per frame.
        most_speed: Largest speed, in cells per frame.
    """

    cells: int
    shape: tuple[int, ...]
    per_cell: float
    median_speed: float
    high_speed: float
    most_speed: float


@dataclass(frozen=True)
class Inspection:
    """The results; lengths in domain length, times in seconds.

    Args:
        path: Of the dataset.
        dim: Number of axes.
        dt: Time between frames.
        splits: By name.
        materials: Particles of each material in a trajectory, by name.
        stated_bounds: The metadata's.
        observed: Extent of all positions.
        domain: Extent that a grid should cover.
        boundary: "wall" or "periodic" per axis.
        gravity: In length/s², where it is known and the same for all trajectories.
        first_acceleration: Median in the first frames, in length/s²; equals gravity where particles start in free fall.
        spacing: Median distance to the nearest neighbour in first frames.
        varies: What differs between trajectories: "gravity", "materials", "particles", "frames", "obstacles", fields.
        fields: Shape of each further array, in the first trajectory.
        grids: Candidate grids.
        recommended: Recommended cells along the longest side.
        occupied: Fraction of the domain that a particle ever visits, in all trajectories together.
        occupied_each: The same in one trajectory, median.
        rest: First frame from which a trajectory is at rest: median, smallest, largest; None where none comes to rest.
        restless: Trajectories that still move at their end.
        notes: Notes that need no action.
        findings: Anomalies.
        channels: For each field how it differs, and which channels of a model that makes.
    """

    path: str
    dim: int
    dt: float
    splits: dict[str, SplitFacts]
    materials: dict[str, Range]
    stated_bounds: tuple[Interval, ...]
    observed: tuple[Interval, ...]
    domain: tuple[Interval, ...]
    boundary: tuple[str, ...]
    gravity: tuple[float, ...] | None
    first_acceleration: tuple[float, ...]
    spacing: float
    varies: tuple[str, ...]
    fields: dict[str, tuple[int, ...]]
    grids: tuple[GridFacts, ...]
    recommended: int
    occupied: float
    occupied_each: float
    rest: tuple[int, int, int] | None
    restless: int
    notes: tuple[str, ...]
    findings: tuple[str, ...]
    channels: dict[str, str]
