"""Kernels that leave resting particles where something holds them up, as `nmpm.emulator.support` does.

Arrays are those of one scene. Nodes are numbered as in the grid state; along an axis they lie `stride` apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.emulator.contact import SURFACE
from nmpm.emulator.fused.contact import depths, widen
from nmpm.emulator.fused.flight import confine
from nmpm.emulator.support import ENOUGH, MAX_DROP, REACH

ZERO, HALF = np.float32(0), np.float32(0.5)
_ENOUGH, _SURFACE, _MAX_DROP = np.float32(ENOUGH), np.float32(SURFACE), np.float32(MAX_DROP)


@jit
def support(state: Any, channels: Any, share: Any, gravity: Any, grid: Any, floors: Any, held: Any) -> Any:
    """Fill in whether the material in each cell is held up.

    Args:
        state: (size, C), the grid state.
        channels: Its first channel that is a volume fraction, and the one after the last.
        share: (size,) of each cell's room that is obstacle; empty where there are no obstacles.
        gravity: (D,).
        grid: The tuple of shape and periodic axes.
        floors: (D, 2), as `nmpm.emulator.support.floor_rows`.
        held: (size,) bool, is filled.
    """
    shape, wraps = grid
    axis, largest = 0, ZERO
    for d in range(len(shape)):
        if abs(gravity[d]) > largest:
            axis, largest = d, abs(gravity[d])
    held[:] = True
    if largest == ZERO or wraps[axis]:
        return
    bears = np.empty(len(held), np.bool_)
    for node in range(len(held)):
        filled = ZERO
        for channel in range(channels[0], channels[1]):
            filled += state[node, channel]
        bears[node] = filled >= _ENOUGH
    for other in range(len(shape)):
        if other != axis:
            bears = widen(bears, shape, wraps, other)
    upwards = gravity[axis] > ZERO
    _sweep(bears, share, shape, axis, upwards, floors[axis, 1 if upwards else 0], held)


@jit
def _stride(shape: Any, axis: Any) -> Any:
    """How far neighbours along an axis are apart."""
    stride = 1
    for d in range(axis + 1, len(shape)):
        stride *= shape[d]
    return stride


@jit
def _sweep(bears: Any, share: Any, shape: Any, axis: Any, upwards: Any, floor: Any, held: Any) -> Any:
    """Fill in `held` column by column from the floor, which gravity points to, on the way up."""
    stride, extent = _stride(shape, axis), shape[axis]
    for first in range(0, len(held), stride * extent):
        for column in range(first, first + stride):
            empty, broken = 0, False
            for row in range(extent):
                node = column + (extent - 1 - row if upwards else row) * stride
                held[node] = not broken
                if row < floor or (len(share) > 0 and share[node] >= _SURFACE):
                    empty, broken = 0, False
                elif bears[node]:
                    empty = 0
                else:
                    empty += 1
                    broken = broken or empty >= REACH


@jit
def fill_drops(gravity: Any, drops: Any) -> Any:
    """Fill in (m, D) what a particle falls from rest until each frame, as `nmpm.emulator.support.drops`."""
    frames, square = len(drops), ZERO
    for d in range(len(gravity)):
        square += gravity[d] * gravity[d]
    longest = np.float32(frames * (frames + 1) / 2) * np.sqrt(square)
    factor = _MAX_DROP / max(longest, _MAX_DROP)
    for frame in range(frames):
        part = np.float32((frame + 1) * (frame + 2) / 2)
        for d in range(len(gravity)):
            drops[frame, d] = gravity[d] * factor * part


@jit
def rest(
    cells: Any,
    path: Any,
    gravity: Any,
    speed: Any,
    free_fall: Any,
    share: Any,
    grid: Any,
    held: Any,
    bounds: Any,
    low: Any,
    high: Any,
) -> Any:
    """Leave particles where they started that neither move nor fall, as `nmpm.emulator.constraints.at_rest` says.

    Those that nothing holds up fall instead.

    Args:
        cells: (N, D) positions at the bundle's start.
        path: (m, N, D), is changed.
        gravity: (D,), what a frame adds to a velocity.
        speed: Cells per frame.
        free_fall: Share of gravity.
        share: (size,) of each cell's room that is obstacle; empty where there are no obstacles.
        grid: The tuple of shape and periodic axes.
        held: (size,) bool, from `support`.
        bounds: As for `flight.fly`.
        low: The first particle.
        high: The one after the last.
    """
    frames, dim = len(path), cells.shape[1]
    drops, still = np.empty((frames, dim), np.float32), np.empty(high - low, np.bool_)
    fill_drops(gravity, drops)
    middle = path[max(frames // 2, 1) - 1, low:high]
    _find_still(cells[low:high], middle, path[frames - 1, low:high], frames, gravity, speed, free_fall, still)
    place, value = np.empty((1, dim), np.float32), np.empty(1, np.float32)
    for p in range(low, high):
        if not still[p - low]:
            continue
        falls = not held[_node(cells, grid, p)]
        if falls and len(share) > 0:
            for d in range(dim):
                place[0, d] = cells[p, d] + drops[frames - 1, d]
            depths(share, place, grid, value)
            falls = not value[0] > _SURFACE
        for frame in range(frames):
            for d in range(dim):
                x = cells[p, d]
                if falls:
                    x = confine(x + drops[frame, d], bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)
                path[frame, p, d] = x


@jit
def _find_still(
    cells: Any, middle: Any, last: Any, frames: Any, gravity: Any, speed: Any, free_fall: Any, still: Any
) -> Any:
    """Fill in which particles neither move nor fall, from their places at a bundle's start, half-way and at its end."""
    early = np.float32(max(frames // 2, 1))
    late = np.float32(max(frames - frames // 2, 1))
    furthest, square = speed * np.float32(frames), ZERO
    for d in range(len(gravity)):
        square += gravity[d] * gravity[d]
    falling = free_fall * np.float32(frames) * HALF * square
    for p in range(len(cells)):
        moved, gained = ZERO, ZERO
        for d in range(len(gravity)):
            way = last[p, d] - cells[p, d]
            moved += way * way
            gained += ((last[p, d] - middle[p, d]) / late - (middle[p, d] - cells[p, d]) / early) * gravity[d]
        still[p] = np.sqrt(moved) < furthest and not (frames > 1 and gained > falling)


@jit
def _node(cells: Any, grid: Any, p: Any) -> Any:
    """The cell that a particle, whose position is finite, is in."""
    shape, wraps = grid
    node = np.int64(0)
    for d in range(len(shape)):
        row = np.int64(np.floor(cells[p, d]))
        node = node * shape[d] + (row % shape[d] if wraps[d] else min(max(row, 0), shape[d] - 1))
    return node
