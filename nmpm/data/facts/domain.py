"""What a grid should cover: the bounds, obstacles, and a layer of wall of whole cells."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nmpm.data.facts.fact import Fact
from nmpm.data.grid_rule import LEAST_CELLS, MULTIPLE, PER_AXIS
from nmpm.scene import Boundary, Interval

_ROUNDED = 1e-4  # of a cell


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
