"""Bounds and boundaries, axis by axis: periods, open ends, walls, or merely how far particles came."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nmpm.data.facts.fact import Fact
from nmpm.data.facts.openings import Openings, find_openings
from nmpm.data.facts.periodic import Period, find_period
from nmpm.data.facts.walls import Wall, find_wall
from nmpm.scene import Boundary, Interval

Ends = tuple[np.ndarray, np.ndarray]
"""Lower and upper ends (D,)."""

_MARGIN = 0.05  # of the extent, where no wall was touched
_BEYOND = 2.0  # spacings beyond which positions do not belong to a wall


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
    def certain(self) -> bool:
        """Whether both ends were seen."""
        return bool(
            self.period or self.opens or (self.lower and self.lower.certain and self.upper and self.upper.certain)
        )

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
            return f"{self.name}: the period {self.period.length:.6g}, found from {self.period.jumps} jumps"
        if self.opens:
            return f"{self.name}: the extent of all positions"
        met = [f"{wall.coordinate:.5g} ({wall.touched} of {wall.trajectories} trajectories)" for wall in self._walls]
        parts = [f"particles stop or turn at {' and '.join(met)}"] if met else []
        if len(met) < 2:
            where = "" if not met else " above" if self.lower else " below"
            parts.append(f"no wall was met{where}, so the extreme position and up to {_MARGIN:.0%}")
        return f"{self.name}: {', '.join(parts)}"

    @property
    def _walls(self) -> list[Wall]:
        return [wall for wall in (self.lower, self.upper) if wall is not None]


def _round(steps: int, unit: float) -> float:
    return float(f"{steps * unit:.12g}")


def find_axes(
    positions: Sequence[np.ndarray], extent: Ends, solid: Ends | None, spacing: float
) -> tuple[tuple[Axis, ...], Openings]:
    """The axes, and where tracks end.

    Args:
        positions: Of moving particles in some trajectories, (F, N, D) each.
        extent: Of all moving particles.
        solid: Extent of all other particles; None where there are none.
        spacing: Typical distance of neighbours.
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
    how = "; ".join(axis.sentence() for axis in axes) + "."
    bounds = tuple(axis.bounds(spacing) for axis in axes)
    if all(axis.certain for axis in axes):
        return Fact(bounds, how, "measured")
    ends = [axis.period or axis.opens or (axis.lower and axis.upper) for axis in axes]
    return Fact(bounds, how, "likely" if all(ends) else "guessed")


def boundary_fact(axes: Sequence[Axis], openings: Openings) -> Fact[tuple[Boundary, ...]]:
    """The kind of boundary of each axis."""
    parts = [f"{axis.name}: particles wrap" for axis in axes if axis.period]
    names = ", ".join(axis.name for axis in axes if axis.opens)
    if names and openings.anywhere:
        parts.append(f"{names}: {openings.ends} tracks end and {openings.starts} begin on the way, anywhere")
    elif names:
        parts.append(f"{names}: {openings.ends} tracks end near its ends, {openings.starts} begin on the way")
    if walls := [axis.name for axis in axes if axis.boundary == "wall" and (axis.lower or axis.upper)]:
        parts.append(f"{', '.join(walls)}: particles stop or turn at walls")
    if rest := [axis.name for axis in axes if axis.boundary == "wall" and not (axis.lower or axis.upper)]:
        parts.append(f"{', '.join(rest)}: taken for walls, though none was touched")
    kinds = tuple(axis.boundary for axis in axes)
    return Fact(kinds, "; ".join(parts) + ".", "guessed" if rest else "measured")
