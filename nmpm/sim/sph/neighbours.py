"""Pairs of particles that are near each other, found through a grid of square cells as large as the reach.

Particles are sorted by cell, row after row. The neighbours of a particle then lie in three runs of indices, one for
each row of cells around it, and every pair is found once, from the particle that comes first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.sim.state import Array

Indices = NDArray[np.uint32]


class Pairs(NamedTuple):
    """K pairs of fluid particles; arrays of shape (K,), the last four written by `pair_geometry` and `expansion`.

    `dx` and `dy` are differences of position, first minus second; `drag` is F v · x / (r² + 0.01 h²), for viscosity.
    """

    first: Indices
    second: Indices
    dx: Array
    dy: Array
    f: Array
    drag: Array


class WallPairs(NamedTuple):
    """K pairs of a fluid and a wall particle, likewise by `wall_geometry`; `w` is W."""

    first: Indices
    second: Indices
    dx: Array
    dy: Array
    f: Array
    w: Array


class Cells(NamedTuple):
    """Square cells, numbered row after row from the lower left corner."""

    left: float
    bottom: float
    per_length: float
    columns: int


class PairLists:
    """Lists pairs of particles near each other and near the walls, in memory that it reuses.

    The cells cover the walls, with one more ring of cells that stay empty.

    Args:
        walls: (M, 2) positions of the wall particles, which surround all others.
        reach: Distance within which pairs are listed, in length.
    """

    def __init__(self, walls: Array, reach: float) -> None:
        low, high = walls.min(0), walls.max(0)
        columns, self._rows = (int(n) + 4 for n in (high - low) / reach)
        left, bottom = (low - 1.001 * reach).tolist()
        # Reduced slightly so that rounding never puts a pair two cells apart.
        self._cells, self._reach = Cells(left, bottom, (1.0 - 1e-9) / reach, columns), reach
        order, self._wall_starts = self.sort_by_cell(*np.ascontiguousarray(walls.T))
        self.wall_x, self.wall_y = np.ascontiguousarray(walls[order].T)
        """(M,) positions of the wall particles in the order that pairs refer to."""
        self._memory, self._wall_memory = np.empty((2, 1024), np.uint32), np.empty((2, 1024), np.uint32)

    def sort_by_cell(self, x: Array, y: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Order of the particles by cell, and where each cell's run of them starts (cells + 1 numbers).

        Particles must lie within the walls; within a cell they keep their order.
        """
        order = np.empty(len(x), np.int64)
        starts = np.zeros(self._cells.columns * self._rows + 2, np.int64)
        _sort(x, y, self._cells, order, starts)
        return order, starts[:-1]

    def near(self, x: Array, y: Array, starts: NDArray[np.int64]) -> tuple[Pairs, WallPairs]:
        """Every pair of sorted particles once, and every pair of one and a wall particle; valid until the next call."""
        cells, reach, walls = self._cells, self._reach, (self.wall_x, self.wall_y, self._wall_starts)
        self._memory, count = _fill(self._memory, lambda memory: _pairs_within(x, y, starts, cells, reach, memory))
        self._wall_memory, wet = _fill(
            self._wall_memory, lambda memory: _pairs_between(x, y, *walls, cells, reach, memory)
        )
        return (
            Pairs(*self._memory[:, :count], *np.empty((4, count))),
            WallPairs(*self._wall_memory[:, :wet], *np.empty((4, wet))),
        )


def _fill(memory: Indices, fill: Callable[[Indices], int]) -> tuple[Indices, int]:
    """The memory with the pairs, larger if they need more, and their number."""
    count = fill(memory)
    if count >= memory.shape[1]:
        memory = np.empty((2, count + count // 4 + 1), np.uint32)
        fill(memory)
    return memory, count


@jit
def _cell(x: float, y: float, cells: Cells) -> int:
    row, column = int((y - cells.bottom) * cells.per_length), int((x - cells.left) * cells.per_length)
    return row * cells.columns + column


@jit
def _sort(x: Array, y: Array, cells: Cells, order: NDArray[np.int64], starts: NDArray[np.int64]) -> None:
    """Counting sort; `starts` has two more entries than cells, and ends up shifted by one for the filling."""
    cell_of = np.empty(x.shape[0], np.int64)
    for i in range(x.shape[0]):
        cell_of[i] = _cell(x[i], y[i], cells)
        starts[cell_of[i] + 2] += 1
    for c in range(2, starts.shape[0]):
        starts[c] += starts[c - 1]
    for i in range(x.shape[0]):
        order[starts[cell_of[i] + 1]] = i
        starts[cell_of[i] + 1] += 1


# Both count the pairs, and store them if there is more room: every candidate is written, and those too far away are
# overwritten.


@jit
def _pairs_within(x: Array, y: Array, starts: NDArray[np.int64], cells: Cells, reach: float, memory: Indices) -> int:
    reach2, last, count, columns = reach * reach, memory.shape[1] - 1, 0, cells.columns
    for i in range(x.shape[0]):
        xi, yi = x[i], y[i]
        cell = _cell(xi, yi, cells)
        for row in range(2):
            begin = i + 1 if row == 0 else starts[cell + columns - 1]
            for j in range(begin, starts[cell + row * columns + 2]):
                dx, dy = xi - x[j], yi - y[j]
                slot = min(count, last)
                memory[0, slot], memory[1, slot] = i, j
                count += dx * dx + dy * dy < reach2
    return count


@jit
def _pairs_between(
    x: Array, y: Array, wall_x: Array, wall_y: Array, starts: NDArray[np.int64],
    cells: Cells, reach: float, memory: Indices,
) -> int:  # fmt: skip
    reach2, last, count, columns = reach * reach, memory.shape[1] - 1, 0, cells.columns
    for i in range(x.shape[0]):
        xi, yi = x[i], y[i]
        cell = _cell(xi, yi, cells)
        for row in range(-1, 2):
            middle = cell + row * columns
            for j in range(starts[middle - 1], starts[middle + 2]):
                dx, dy = xi - wall_x[j], yi - wall_y[j]
                slot = min(count, last)
                memory[0, slot], memory[1, slot] = i, j
                count += dx * dx + dy * dy < reach2
    return count
