"""The answers of an inspection."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from nmpm._support.plain_data import to_lists
from nmpm.scene import Interval

Range = tuple[int, int]
"""Least and largest."""


@dataclass(frozen=True)
class SplitFacts:
    """One split.

    Args:
        trajectories: In the file.
        inspected: Looked at in full.
        frames: Of a trajectory.
        particles: Of a trajectory, those that move.
        static: Of a trajectory, those that do not.
    """

    trajectories: int
    inspected: int
    frames: Range
    particles: Range
    static: Range


@dataclass(frozen=True)
class GridFacts:
    """The data on one grid.

    Args:
        cells: Cells along the longest side.
        shape: Cells along each axis.
        per_cell: Particles per cell that holds any, the median over frames.
        median_speed: Of the particles that move, in cells per frame.
        high_speed: The 99.9% quantile, in cells per frame.
        most_speed: The fastest, in cells per frame.
    """

    cells: int
    shape: tuple[int, ...]
    per_cell: float
    median_speed: float
    high_speed: float
    most_speed: float


@dataclass(frozen=True)
class Inspection:
    """What was seen; lengths in domain length, times in seconds.

    Args:
        path: Of the dataset.
        dim: Number of axes.
        dt: Time between frames.
        splits: By name.
        materials: Particles of each material, least and largest in a trajectory, by name.
        stated_bounds: The metadata's.
        observed: Extent of all positions.
        domain: What a grid should cover.
        boundary: "wall" or "periodic" per axis.
        gravity: Where it is known and the same for all.
        first_acceleration: Median in the first frames, in length/s²; gravity, where particles begin in free fall.
        spacing: Median distance to the nearest particle in first frames.
        varies: What differs between trajectories: "gravity", "materials", "particles", "frames", "obstacles".
        fields: Shape of each further array, in the first trajectory.
        grids: Candidate grids.
        recommended: Cells along the longest side.
        occupied: Share of the domain that a particle is ever in: in all trajectories together.
        occupied_each: The same, the median over trajectories.
        rest: First frame from which a trajectory is at rest, the median, least and largest; None where none rests.
        restless: Trajectories that are still moving at their end.
        notes: What is worth knowing.
        findings: What is suspicious.
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

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and numbers."""
        plain = dataclasses.asdict(self)
        return {key: _plain(value) for key, value in plain.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return to_lists(value)
