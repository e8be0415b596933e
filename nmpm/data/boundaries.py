"""Ends of the domain along each axis: walls, periods, and ends through which particles come and go."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from nmpm.data.grid_rule import LEAST_CELLS, MULTIPLE, PER_AXIS
from nmpm.data.metadata import Fact, Sure
from nmpm.data.statistics import lengths, roundest
from nmpm.scene import Boundary, Interval

FEW_CROSSINGS = 3
"""From one end of all positions to the other: fewer are jumps, unless their period is the extent."""
_CROSSING = 0.8  # of the extent of all positions
_GOES_ON = 0.5  # of a step: the steps before and after one across ends differ by less
_MOST_GO_ON = 0.5  # of the steps across ends
OUTWARD = 0.02
"""Spacings in a frame: slower particles may just come to rest."""
_RESTLESS = 0.2  # of the extent: particles whose typical step is longer do not cross ends, they are anywhere
_AGREE = 0.02  # of the period
_FULL = 0.01  # of the period: how far the extent may differ from it where jumps are few
_ROUNDING = 1e-4  # of the period: errors that are rounded away
_ZONE = 0.1  # of the extent at each end: where particles that leave an axis are seen last
_GONE = 5  # frames after which an absent particle has left; another may be in its place later
_MOST = 0.6  # of the ends of tracks: if so many are in the zones of some axes, those axes explain them
_ENRICHED = 2.0  # times as many ends of tracks in the zones as positions


@dataclass(frozen=True)
class Period:
    """The period of an axis."""

    lower: float
    length: float
    jumps: int  # that it was found from

    @property
    def interval(self) -> tuple[float, float]:
        """(lower, upper), one period apart."""
        return self.lower, self.lower + self.length


def find_crossings(step: np.ndarray, extent: np.ndarray, spacing: float, periodic: Sequence[bool]) -> np.ndarray:
    """(D, T - 1, N) whether a particle leaves at one end of all positions and goes on from the other as it came.

    From steps (T - 1, N, D) and the extent (D,) of all positions. Particles that reappear with another velocity, or
    elsewhere along the other axes, are moved by somebody. Steps on axes that are known as periodic are none.
    """
    crosses = np.zeros((len(extent), *step.shape[:2]), dtype=bool)
    for axis in np.flatnonzero(~np.asarray(periodic)):
        size = np.abs(step[..., axis])
        crosses[axis] = size > _CROSSING * extent[axis]
        particles = np.flatnonzero(crosses[axis].any(axis=0))
        if len(particles):
            restless = np.nanmedian(size[:, particles], axis=0) > _RESTLESS * extent[axis]
            crosses[axis, :, particles[restless]] = False
    frames, particles = np.nonzero(crosses.any(axis=0))
    if len(frames):
        jump, expected = step[frames, particles], _expected(step, frames, particles)
        allowed = _GOES_ON * lengths(expected.mean(axis=0))[:, None] + OUTWARD * spacing
        straight = np.where(
            crosses[:, frames, particles].T,
            np.sign(jump) != np.sign(expected.mean(axis=0)),
            np.abs(jump - expected.mean(axis=0)) < allowed,
        )
        goes_on = ((np.abs(expected[0] - expected[1]) < allowed) & straight).all(axis=1)
        goes_on &= goes_on.mean() > _MOST_GO_ON  # else some do by chance
        crosses[:, frames[~goes_on], particles[~goes_on]] = False
    return crosses


def _expected(step: np.ndarray, frames: np.ndarray, particles: np.ndarray) -> np.ndarray:
    """(2, K, D) steps before and after K steps of particles; of the first and the last step only one is known."""
    final = len(step) - 1
    before, after = np.where(frames > 0, frames - 1, 1), np.where(frames < final, frames + 1, final - 1)
    return np.stack([step[np.clip(index, 0, final), particles] for index in (before, after)])


def find_periods(
    positions: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray, spacing: float
) -> list[Period | None]:
    """The period of each axis, where positions (F, N, D) lie between low and high (D,); None where they do not wrap."""
    periods: list[list[np.ndarray]] = [[np.empty(0)] for _ in low]
    for position in positions:
        step = np.diff(position, axis=0)
        for axis, crosses in enumerate(find_crossings(step, high - low, spacing, [False] * len(low))):
            frames, particles = np.nonzero(crosses)
            excess = step[frames, particles] - _expected(step, frames, particles).mean(axis=0)
            periods[axis].append(np.abs(excess[:, axis]))
    return [
        _period(np.concatenate(each), *ends) for each, *ends in zip(periods, low.tolist(), high.tolist(), strict=True)
    ]


def _period(measured: np.ndarray, low: float, high: float) -> Period | None:
    if not len(measured):
        return None
    length, least = float(np.median(measured)), high - low
    close = np.abs(measured - length) < _AGREE * length
    if close.mean() < 0.5 or (close.sum() < FEW_CROSSINGS and abs(length - least) > _FULL * length):
        return None
    error = 3 * float(np.std(measured[close])) / math.sqrt(close.sum()) + _ROUNDING * length
    length = roundest(max(length - error, least), max(length, least) + error)
    slack = _ROUNDING / 10 * length
    return Period(roundest(min(high - length, low) - slack, low + slack), length, int(close.sum()))


def unwrap(position: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """(F, N, D) positions that go on where particles wrap; `periods` (D,) are 0 along axes that do not."""
    if not periods.any():
        return position
    safe = np.where(periods > 0, periods, 1.0)
    step = np.diff(position, axis=0)
    turns = np.where(periods > 0, np.round(step / safe), 0.0)
    unwrapped: np.ndarray = position.copy()
    unwrapped[1:] -= np.cumsum(np.nan_to_num(turns), axis=0) * periods
    return unwrapped


@dataclass(frozen=True)
class Openings:
    """The axes along which particles leave."""

    axes: frozenset[int]
    ends: int  # tracks that end before the last frame
    starts: int  # tracks that begin after the first one
    anywhere: bool  # whether tracks end in mid volume as well


def find_openings(positions: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray) -> Openings:
    """The axes near whose ends tracks end, in positions (F, N, D) of each trajectory, NaN where absent.

    Where most tracks end elsewhere, as in a measured volume, particles come and go along all axes.
    """
    dim = len(low)
    last = np.concatenate([np.empty((0, dim)), *(_track_ends(each) for each in positions)])
    first = sum(len(_track_ends(each[::-1])) for each in positions)
    if not len(last):
        return Openings(frozenset(), 0, first, anywhere=False)
    some = np.concatenate([each[np.isfinite(each).all(axis=2)][::7] for each in positions])
    zone = _ZONE * (high - low)
    near = (last < low + zone) | (last > high - zone)
    usual = ((some < low + zone) | (some > high - zone)).mean(axis=0)
    enriched = np.flatnonzero(near.mean(axis=0) > np.maximum(_ENRICHED * usual, _ZONE))
    if near[:, enriched].any(axis=1).mean() > _MOST:
        return Openings(frozenset(enriched.tolist()), len(last), first, anywhere=False)
    return Openings(frozenset(range(dim)), len(last), first, anywhere=True)


def _track_ends(position: np.ndarray) -> np.ndarray:
    """The last positions (K, D) of particles that are then absent for five frames, or until the end."""
    present = np.isfinite(position).all(axis=2)
    ends = present[:-1].copy()
    for later in range(1, min(_GONE, len(ends)) + 1):
        ends[: len(present) - later] &= ~present[later:]
    return np.asarray(position[:-1][ends], np.float64)


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
class AxisEnds:
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
) -> tuple[tuple[AxisEnds, ...], Openings]:
    """The axes, and where tracks end, by positions (F, N, D) of moving particles in some trajectories.

    The extents are of all moving particles, and of all others (`solid`, if any); `spacing` is that of neighbours.
    """
    openings = find_openings(positions, *extent)
    axes = []
    for axis, (low, high, period) in enumerate(zip(*extent, find_periods(positions, *extent, spacing), strict=True)):
        lower, upper = (None if period else find_wall(positions, axis, end, spacing) for end in (False, True))
        axes.append(
            AxisEnds(
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


def bounds_fact(axes: Sequence[AxisEnds], spacing: float) -> Fact[tuple[Interval, ...]]:
    """Where particles may be."""
    names: dict[str, list[str]] = {}
    for axis in axes:
        names.setdefault(axis.sentence(), []).append(axis.name)
    how = "; ".join(f"{', '.join(same)}: {sentence}" for sentence, same in names.items()) + "."
    bounds = tuple(axis.bounds(spacing) for axis in axes)
    return Fact(bounds, how, max((axis.sure for axis in axes), key=get_args(Sure).index))


def boundary_fact(axes: Sequence[AxisEnds], openings: Openings) -> Fact[tuple[Boundary, ...]]:
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
