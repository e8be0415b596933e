"""Bounds, boundaries and domain, axis by axis: walls, periods, open ends, or merely how far particles came."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from nmpm.data.facts.fact import Fact, Sure
from nmpm.data.facts.open_ends import Openings, Period, find_openings, find_period
from nmpm.data.grid_rule import LEAST_CELLS, MULTIPLE, PER_AXIS
from nmpm.scene import Boundary, Interval

Ends = tuple[np.ndarray, np.ndarray]
"""Lower and upper ends (D,)."""

_MARGIN = 0.05  # of the extent, where no wall was touched
_BEYOND = 2.0  # spacings beyond which positions do not belong to a wall
_ROUNDED = 1e-4  # of a cell
_TOUCH = 0.5  # of the spacing: how far from the outermost coordinate a particle touches
_ARRIVAL = 0.25  # of the spacing: how far it came from, at least
_ALIKE = 1.0  # of the spacing: by how much trajectories' outermost coordinates may differ
_CROSSED = 2.0  # of the spacing: no wall lets a particle through by that much
_RESTS = 0.02  # of the spacing: particles that move less in the last frame are at rest
_SHARE = 0.003  # of a trajectory's particles, that must touch
_SINGLE_SHARE = 0.02  # the same where there is one trajectory: crests of waves turn as well
_LEAST = 3  # particles
_SLIDE = 0.25  # of the frames, in which a particle that slides along touches


@dataclass(frozen=True)
class Wall:
    """Where an end of an axis is, and in how many trajectories it was touched."""

    coordinate: float
    touched: int  # trajectories
    trajectories: int

    def __str__(self) -> str:
        return f"{self.coordinate:.5g} ({self.touched} of {self.trajectories} trajectories)"

    @property
    def certain(self) -> bool:
        """Whether it was touched in several trajectories, so that no single event explains it."""
        return self.touched >= 3 or self.touched == self.trajectories >= 2


def find_wall(positions: Sequence[np.ndarray], axis: int, upper: bool, spacing: float) -> Wall | None:
    """The wall at an end of an axis, in positions (F, N, D) of each trajectory; None where none is touched."""
    share = _SHARE if len(positions) > 1 else _SINGLE_SHARE
    outermost_of_each = (_touch(each, axis, upper, spacing, share) for each in positions)
    touches = [touch for touch in outermost_of_each if touch is not None]
    outermost = min(touches, default=math.inf)
    count = sum(touch < outermost + _ALIKE * spacing for touch in touches)
    if not touches or count < min(2, len(positions)):
        return None
    return Wall(-outermost if upper else outermost, count, len(positions))


def _touch(position: np.ndarray, axis: int, upper: bool, spacing: float, share: float) -> float | None:
    """The lowest coordinate (negated at an upper end) where enough particles of a trajectory stop, turn or slide."""
    along = -position[..., axis] if upper else position[..., axis]
    seen = np.isfinite(along).any(axis=0)
    if not seen.any():
        return None
    height = np.where(np.isfinite(along[:, seen]), along[:, seen], np.inf)
    lowest = height.min(axis=0)
    when = height.argmin(axis=0)
    before = np.arange(len(height))[:, None] < when
    came = np.where(before & np.isfinite(height), height, -np.inf).max(axis=0) > lowest + _ARRIVAL * spacing
    final = height[-1] < lowest + _TOUCH * spacing
    rests = np.abs(along[-1, seen] - along[-2:, seen][0]) < _RESTS * spacing
    stops = ~final | rests
    near = height < lowest + _ARRIVAL * spacing
    others = np.delete(position[:, seen], axis, axis=2)
    slides = (near.mean(axis=0) > _SLIDE) & _moves(others, near, 2 * spacing)
    touching = np.sort(lowest[(came & stops) | slides])
    least = max(min(_LEAST, len(lowest)), round(share * len(lowest)))
    if len(touching) < least:
        return None
    bottom = float(touching[least - 1])
    deepest = float(np.sort(lowest)[min(len(lowest), least) - 1])
    # Where others were deeper without stopping, or one far deeper, this is no wall.
    crossed = deepest < bottom - _TOUCH * spacing or lowest.min() < bottom - _CROSSED * spacing
    return None if crossed else bottom


def _moves(others: np.ndarray, near: np.ndarray, distance: float) -> np.ndarray:
    """Whether each particle (F, N, D - 1) moves further than that in frames where it is near."""
    if not others.shape[2]:
        return np.zeros(others.shape[1], bool)
    masked = np.where(near[..., None], others, np.nan)
    low, high = np.fmin.reduce(masked, axis=0), np.fmax.reduce(masked, axis=0)
    moves: np.ndarray = np.nan_to_num(high - low).max(axis=1) > distance
    return moves


@dataclass(frozen=True)
class Axis:
    """What was found about one axis."""

    name: str
    low: float  # of all positions of moving particles
    high: float
    solid: Interval  # of all obstacles
    period: Period | None
    opens: bool
    lower: Wall | None
    upper: Wall | None

    @property
    def boundary(self) -> Boundary:
        """The kind of its boundary."""
        return "periodic" if self.period else "open" if self.opens else "wall"

    @property
    def sure(self) -> Sure:
        """How sure its ends are."""
        if self.period or self.opens or (self.lower and self.lower.certain and self.upper and self.upper.certain):
            return "measured"
        return "likely" if self.lower and self.upper else "guessed"

    def bounds(self, spacing: float) -> Interval:
        """(lower, upper): the period, the extent of positions at open ends and walls, or more where none was met."""
        if self.period:
            return self.period.interval
        low, high = self.low - self._margin(self.lower, spacing), self.high + self._margin(self.upper, spacing)
        # Obstacles beyond the particles are beyond the bounds.
        if self.low > self.solid[0]:
            low = max(low, self.solid[0])
        if self.high < self.solid[1]:
            high = min(high, self.solid[1])
        unit = 10.0 ** math.floor(math.log10(spacing / 20))
        return _round(math.floor(low / unit), unit), _round(math.ceil(high / unit), unit)

    def _margin(self, wall: Wall | None, spacing: float) -> float:
        """What is added to the extreme position, where it is no end."""
        flat = self.high - self.low < spacing
        if (self.opens or (wall and wall.certain)) and not flat:
            return 0.0
        return spacing if wall else max(_MARGIN * (self.high - self.low), spacing)

    def sentence(self) -> str:
        """How its bounds were found."""
        if self.period:
            return f"the period {self.period.length:.6g}, found from {self.period.jumps} jumps"
        if self.opens:
            return "the extent of all positions"
        met = [str(wall) for wall in (self.lower, self.upper) if wall]
        parts = [f"particles stop or turn at {' and '.join(met)}"] if met else []
        if len(met) < 2:
            where = "" if not met else " above" if self.lower else " below"
            parts.append(f"no wall was met{where}, so the extreme position and up to {_MARGIN:.0%}")
        return ", ".join(parts)


def _round(steps: int, unit: float) -> float:
    return float(f"{steps * unit:.12g}")


def find_axes(
    positions: Sequence[np.ndarray], extent: Ends, solid: Ends | None, spacing: float
) -> tuple[tuple[Axis, ...], Openings]:
    """The axes, and where tracks end, by positions (F, N, D) of moving particles in some trajectories.

    The extents are of all moving particles, and of all others (`solid`, if any); `spacing` is that of neighbours.
    """
    openings = find_openings(positions, *extent)
    axes = []
    for axis, (low, high) in enumerate(zip(*extent, strict=True)):
        period = find_period(positions, axis, *extent)
        lower, upper = (None if period else find_wall(positions, axis, end, spacing) for end in (False, True))
        axes.append(
            Axis(
                name="xyz"[axis],
                low=float(low),
                high=float(high),
                solid=(-np.inf, np.inf) if solid is None else (float(solid[0][axis]), float(solid[1][axis])),
                period=period,
                opens=axis in openings.axes and period is None,
                # A wall is where the outermost particles are.
                lower=lower if lower and lower.coordinate - low < _BEYOND * spacing else None,
                upper=upper if upper and high - upper.coordinate < _BEYOND * spacing else None,
            )
        )
    return tuple(axes), openings


def bounds_fact(axes: Sequence[Axis], spacing: float) -> Fact[tuple[Interval, ...]]:
    """Where particles may be."""
    names: dict[str, list[str]] = {}
    for axis in axes:
        names.setdefault(axis.sentence(), []).append(axis.name)
    how = "; ".join(f"{', '.join(same)}: {sentence}" for sentence, same in names.items()) + "."
    bounds = tuple(axis.bounds(spacing) for axis in axes)
    return Fact(bounds, how, max((axis.sure for axis in axes), key=get_args(Sure).index))


def boundary_fact(axes: Sequence[Axis], openings: Openings) -> Fact[tuple[Boundary, ...]]:
    """The kind of boundary of each axis."""
    parts = [f"{axis.name}: particles wrap" for axis in axes if axis.period]
    if names := ", ".join(axis.name for axis in axes if axis.opens):
        ends, starts = openings.ends, openings.starts
        anywhere = f"tracks end and {starts} begin on the way, anywhere"
        near = f"tracks end near its ends, {starts} begin on the way"
        parts.append(f"{names}: {ends} {anywhere if openings.anywhere else near}")
    if walls := [axis.name for axis in axes if axis.boundary == "wall" and (axis.lower or axis.upper)]:
        parts.append(f"{', '.join(walls)}: particles stop or turn at walls")
    if rest := [axis.name for axis in axes if axis.boundary == "wall" and not (axis.lower or axis.upper)]:
        parts.append(f"{', '.join(rest)}: taken for walls, though none was touched")
    kinds = tuple(axis.boundary for axis in axes)
    return Fact(kinds, "; ".join(parts) + ".", "guessed" if rest else "measured")


def domain_fact(
    bounds: Sequence[Interval], boundary: Sequence[Boundary], obstacles: Sequence[Interval] | None, spacing: float
) -> Fact[tuple[Interval, ...]]:
    """The domain of a grid whose cells hold about as many particles as the rule for grids wants.

    At a wall it goes one cell beyond the bounds, or as far as obstacles; at another end it is the bounds. Sides with
    walls are whole numbers of cells, the longest a multiple of 8 where obstacles do not need more.
    """
    longest = max(high - low for low, high in bounds)
    wanted = longest / (PER_AXIS * spacing) + 2
    number = max(round(wanted / MULTIPLE) * MULTIPLE, LEAST_CELLS[len(bounds)])
    cell = longest / (number - 2)
    intervals = []
    for axis, (low, high) in enumerate(bounds):
        if boundary[axis] != "wall":
            intervals.append((low, high))
            continue
        outer = obstacles[axis] if obstacles else (low, high)
        intervals.append(_whole_cells(min(low - cell, outer[0]), max(high + cell, outer[1]), cell))
    if "wall" not in boundary:
        return Fact(tuple(intervals), "the bounds: no axis has walls.", "measured")
    number = round(max(high - low for low, high in intervals) / cell)
    how = f"a cell of wall beyond the bounds, with about {number} cells along the longest side."
    return Fact(tuple(intervals), how, "likely")


def _whole_cells(low: float, high: float, cell: float) -> Interval:
    """An interval around another one with the same middle, a whole number of cells long; its ends are rounded."""
    sides = math.ceil((high - low) / cell - _ROUNDED)
    excess = max(sides * cell - (high - low), 0.0) / 2
    unit = 10.0 ** math.floor(math.log10(_ROUNDED * cell))
    ends = np.floor((low - excess) / unit) * unit, np.ceil((high + excess) / unit) * unit
    return float(f"{ends[0]:.12g}"), float(f"{ends[1]:.12g}")
