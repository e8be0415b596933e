"""Rectangular windows that hold marked blocks at the least cost: boxes are cut in two while that makes them cheaper."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nmpm.emulator.windows.axis import BLOCK, Axis
from nmpm.emulator.windows.occupied import Blocks

CALL_CELLS = 2000
"""Cells that a network computes in the time that a further window costs beside its cells."""


@dataclass(frozen=True)
class Window:
    """A part of one scene's grid.

    Args:
        scene: Its index in the batch.
        start: First cell along each axis, negative where the window wraps.
        shape: Cells along each axis.
    """

    scene: int
    start: tuple[int, ...]
    shape: tuple[int, ...]

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class _Cut:
    """The cheapest cut of a box: before which block along which axis, and the cells of both sides' windows."""

    cost: float
    axis: int
    place: int


def cover_scene(blocks: Blocks, axes: Sequence[Axis], scene: int, most: int) -> list[Window]:
    """Windows in which the marked blocks (*blocks) of a scene may be read.

    Args:
        blocks: True where particles may be.
        axes: Of the grid.
        scene: Its index in the batch.
        most: Cells of a window at most; but a part narrower than the halo is not cut for that, as it would cost more.
    """
    return [_window(box, axes, scene) for box in _boxes(blocks, tuple(0 for _ in axes), axes, most)]


def _boxes(blocks: Blocks, origin: tuple[int, ...], axes: Sequence[Axis], most: int) -> Iterator[list[tuple[int, int]]]:
    """Boxes of blocks, (first, last exclusive) along each axis."""
    if not blocks.any():
        return
    inside = [_ends(blocks, axis) for axis in range(blocks.ndim)]
    tight = blocks[tuple(slice(low, high) for low, high in inside)]
    first = tuple(place + low for place, (low, _) in zip(origin, inside, strict=True))
    box = [(low, low + count) for low, count in zip(first, tight.shape, strict=True)]
    cost = math.prod(int(axis.span(*ends)[1]) for axis, ends in zip(axes, box, strict=True))
    cuts = [cut for axis in range(tight.ndim) if (cut := _cheapest_cut(tight, first, axes, axis))]
    best = min(cuts, key=lambda cut: cut.cost, default=None)
    if best is None or best.cost + CALL_CELLS >= cost:
        longest = int(np.argmax(tight.shape))
        if cost <= most or tight.shape[longest] * BLOCK <= max(axes[longest].halo, BLOCK):
            yield box
            return
        best = _Cut(cost, longest, tight.shape[longest] // 2)
    below, above = np.split(tight, [best.place], axis=best.axis)
    yield from _boxes(below, first, axes, most)
    shifted = tuple(place + best.place * (axis == best.axis) for axis, place in enumerate(first))
    yield from _boxes(above, shifted, axes, most)


def _ends(blocks: Blocks, axis: int) -> tuple[int, int]:
    """First and last marked block along an axis, exclusive."""
    marked = np.flatnonzero(blocks.any(_others(blocks.ndim, axis)))
    return int(marked[0]), int(marked[-1]) + 1


def _others(dim: int, *axes: int) -> tuple[int, ...]:
    return tuple(axis for axis in range(dim) if axis not in axes)


def _cheapest_cut(blocks: Blocks, origin: tuple[int, ...], axes: Sequence[Axis], along: int) -> _Cut | None:
    """The cheapest cut of a tight box across one axis; None if it is one block long.

    The two sides shrink to what is marked in them, along all axes: for all cuts at once, by running extremes of the
    marked range of each slice.
    """
    count = blocks.shape[along]
    if count == 1:
        return None
    below, above = np.ones(count - 1), np.ones(count - 1)
    for axis, line in enumerate(axes):
        lows, highs = _slice_ranges(blocks, along, axis)
        low, high = np.minimum.accumulate(lows)[:-1], np.maximum.accumulate(highs)[:-1]
        below *= line.span(origin[axis] + low, origin[axis] + high)[1]
        low, high = np.minimum.accumulate(lows[::-1])[::-1][1:], np.maximum.accumulate(highs[::-1])[::-1][1:]
        above *= line.span(origin[axis] + low, origin[axis] + high)[1]
    costs = below + above
    place = int(costs.argmin())
    return _Cut(float(costs[place]), along, place + 1)


def _slice_ranges(blocks: Blocks, along: int, axis: int) -> tuple[Any, Any]:
    """For each slice across `along` the first and last marked block, exclusive, along `axis`; reversed if none is."""
    count, length = blocks.shape[along], blocks.shape[axis]
    if axis == along:
        marked, place = blocks.any(_others(blocks.ndim, along)), np.arange(count)
        return np.where(marked, place, length), np.where(marked, place + 1, 0)
    rows: Any = blocks.any(_others(blocks.ndim, along, axis))
    rows = rows if along < axis else rows.T
    some = rows.any(1)
    return np.where(some, rows.argmax(1), length), np.where(some, length - rows[:, ::-1].argmax(1), 0)


def _window(box: list[tuple[int, int]], axes: Sequence[Axis], scene: int) -> Window:
    spans = [axis.span(*ends) for axis, ends in zip(axes, box, strict=True)]
    return Window(scene, tuple(int(start) for start, _ in spans), tuple(int(length) for _, length in spans))
