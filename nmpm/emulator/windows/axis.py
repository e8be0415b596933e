"""Windows along one axis of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]

BLOCK = 4
"""Cells of the blocks along each axis in which windows are planned; the last one of an axis may have fewer."""
_STEP = 16  # cells, at least, by which the lengths of windows differ: fewer shapes make larger batches
READ = 1
"""Cells from that of a position which transfers interpolate from, at most: linear and quadratic kernels."""


@dataclass(frozen=True)
class Axis:
    """One axis of a grid, as a network with a radius sees it.

    Args:
        cells: Number of cells.
        periodic: Whether it wraps.
        radius: Of the network, in cells.
        alignment: Of the network, in cells.
    """

    cells: int
    periodic: bool
    radius: int
    alignment: int

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return -(-self.cells // BLOCK)

    @property
    def halo(self) -> int:
        """Cells between positions that may read a window and its end, where that is not the domain's."""
        return self.radius + READ

    def span(self, first: Any, last: Any) -> tuple[Any, Any]:
        """Start and length of the windows in which blocks `first` to `last`, exclusive, may be read.

        Starts are multiples of the alignment, lengths have the remainder of the whole axis, which the network pads as
        it pads that. On a periodic axis a start may be negative. Arguments are integers or arrays of them.
        """
        low = np.asarray(first) * BLOCK - self.halo
        high = np.minimum(np.asarray(last) * BLOCK, self.cells) + self.halo
        low = low // self.alignment * self.alignment
        rest, step = self.cells % self.alignment, _round_up(_STEP, self.alignment)
        if not self.periodic:
            low, high = np.maximum(low, 0), np.minimum(high, self.cells)
        length = np.maximum(-(-(high - low - rest) // step) * step, 0) + rest
        whole = (length >= self.cells) | (self.periodic and rest > 0)
        start = low if self.periodic else np.minimum(low, self.cells - length)
        return np.where(whole, 0, start), np.where(whole, self.cells, length)

    def inner(self, start: int, length: int, margin: int) -> tuple[int, int]:
        """First cell and number of the cells of a window that are `margin` cells from its ends which are not walls."""
        if length == self.cells:
            return start, length
        low = start if start == 0 and not self.periodic else start + margin
        high = start + length
        return low, (high if high == self.cells and not self.periodic else high - margin) - low

    def pieces(self, first: int, count: int) -> list[tuple[slice, slice]]:
        """The cells `first` to `first + count` as slices of the axis, each with where it lies among them."""
        first %= self.cells
        kept = min(count, self.cells - first)
        pieces = [(slice(first, first + kept), slice(0, kept))]
        return pieces if kept == count else [*pieces, (slice(0, count - kept), slice(kept, count))]


def _round_up(least: int, multiple: int) -> int:
    return -(-least // multiple) * multiple
