"""Resting particles stay where something holds them up, else fall: as the torch engine's `support` computes."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.constraints import FREE_FALL_SHARE
from nmpm.emulator.engines.numba.gather import depths
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import CHUNK, confine
from nmpm.emulator.engines.numba.solids import cell_index, stride_of, widen
from nmpm.emulator.engines.numba.state import StartArrays
from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.emulator.engines.torch.support import ENOUGH, MAX_DROP, REACH

ZERO, HALF = np.float32(0), np.float32(0.5)
_ENOUGH, _SURFACE, _MAX_DROP = np.float32(ENOUGH), np.float32(SURFACE), np.float32(MAX_DROP)
_FREE_FALL = np.float32(FREE_FALL_SHARE)


def bring_to_rest(start: StartArrays, parameters: KernelParameters, obstacle: Array, threads: int) -> None:
    """Change the path of a scene: resting particles stay where they started if something holds them up, or fall."""
    held = np.empty(parameters.size, np.bool_)
    find_support(
        start.state, parameters.volume_channels, obstacle, start.gravity, parameters.grid, parameters.floors, held
    )
    stop = partial(
        stop_resting, start.path, start.gravity, np.float32(parameters.rest_speed), obstacle, parameters.grid,
        held, parameters.bounds,
    )  # fmt: skip
    map_ranges(stop, split(len(start.mask), CHUNK), threads)


@jit
def find_support(state: Any, channels: Any, obstacle: Any, gravity: Any, grid: Any, floors: Any, held: Any) -> Any:
    """Fill in `held` (size,) bool: whether the material in each cell is held up.

    `channels` are the state's volume fractions, from and to; `floors` (D, 2) of `support.floor_rows`.
    """
    shape, wraps, _ = grid
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
    _sweep(bears, obstacle, shape, axis, upwards, floors[axis, 1 if upwards else 0], held)


@jit
def _sweep(bears: Any, obstacle: Any, shape: Any, axis: Any, upwards: Any, floor: Any, held: Any) -> Any:
    """Fill in `held` column by column from the floor, which gravity points to, on the way up."""
    stride, extent = stride_of(shape, axis), shape[axis]
    for first in range(0, len(held), stride * extent):
        for column in range(first, first + stride):
            empty, broken = 0, False
            for row in range(extent):
                node = column + (extent - 1 - row if upwards else row) * stride
                held[node] = not broken
                if row < floor or (len(obstacle) > 0 and obstacle[node] >= _SURFACE):
                    empty, broken = 0, False
                elif bears[node]:
                    empty = 0
                else:
                    empty += 1
                    broken = broken or empty >= REACH


@jit
def stop_resting(
    path: Any, gravity: Any, speed: Any, obstacle: Any, grid: Any, held: Any, bounds: Any, low: Any, high: Any
) -> Any:
    """Leave particles where they started that neither move nor fall, as `nmpm.emulator.constraints.at_rest` says.

    Those outside of `held` (size,) cells fall instead. `speed` is the rest speed in cells per frame.
    """
    frames, dim, cells = len(path) - 1, path.shape[2], path[0]
    drops, still = np.empty((frames, dim), np.float32), np.empty(high - low, np.bool_)
    _fill_drops(gravity, drops)
    middle = path[max(frames // 2, 1), low:high]
    _find_still(cells[low:high], middle, path[frames, low:high], frames, gravity, speed, still)
    end, depth = np.empty((1, dim), np.float32), np.empty(1, np.float32)
    for p in range(low, high):
        if not still[p - low]:
            continue
        falls = not held[cell_index(cells, grid, p)]
        if falls and len(obstacle) > 0:
            for d in range(dim):
                end[0, d] = cells[p, d] + drops[frames - 1, d]
            depths(obstacle, end, grid, depth)
            falls = not depth[0] > _SURFACE
        for frame in range(frames):
            for d in range(dim):
                x = cells[p, d]
                if falls:
                    x = confine(x + drops[frame, d], bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)
                path[frame + 1, p, d] = x


@jit
def _fill_drops(gravity: Any, drops: Any) -> Any:
    """Fill in (m, D) what a particle falls from rest until each frame, as the torch engine's `support.drops`."""
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
def _find_still(cells: Any, middle: Any, last: Any, frames: Any, gravity: Any, speed: Any, still: Any) -> Any:
    """Fill in which particles neither move nor fall, from their positions at a bundle's start, half-way and its end."""
    early = np.float32(max(frames // 2, 1))
    late = np.float32(max(frames - frames // 2, 1))
    furthest, square = speed * np.float32(frames), ZERO
    for d in range(len(gravity)):
        square += gravity[d] * gravity[d]
    falling = _FREE_FALL * np.float32(frames) * HALF * square
    for p in range(len(cells)):
        moved, gained = ZERO, ZERO
        for d in range(len(gravity)):
            way = last[p, d] - cells[p, d]
            moved += way * way
            gained += ((last[p, d] - middle[p, d]) / late - (middle[p, d] - cells[p, d]) / early) * gravity[d]
        still[p] = np.sqrt(moved) < furthest and not (frames > 1 and gained > falling)
