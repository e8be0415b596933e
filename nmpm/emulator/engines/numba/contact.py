"""Paths that do not lead into obstacles: as the torch engine's `contact` computes on a CPU.

Particles that touch an obstacle are marked, then only those are followed piece by piece, at most half a cell each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.engines.numba.gather import depths
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import BLOCK, CHUNK, confine, confine_all
from nmpm.emulator.engines.numba.solids import SolidCache, cell_index
from nmpm.emulator.engines.torch.contact import SURFACE

PIECE, EVEN = 0.5, 1e-5  # as in the torch engine's `contact`
CLEAR, TOUCHES, STUCK = 0, 1, 2

_MAX_PIECES = 64
_WAYS_OUT = 4
ZERO, ONE, _INFINITE = np.float32(0), np.float32(1), np.float32(np.inf)


def keep_clear(path: Array, mask: Array, parameters: KernelParameters, solids: SolidCache, threads: int) -> None:
    """Change the path of a scene so that it keeps clear of obstacles, within the bounds."""
    ranges, grid, obstacle = split(len(mask), CHUNK), parameters.grid, solids.obstacle
    pieces = _count_pieces(map_ranges(partial(longest_step, path, mask), ranges, threads))
    marks = np.empty(len(mask), np.int8)
    find = partial(mark, path, mask, obstacle, solids.clearance, grid, pieces, marks)
    if not sum(map_ranges(find, ranges, threads)):
        return
    rows = np.flatnonzero(marks)
    free = np.empty(len(rows), np.int64)
    place, along = np.empty((2, len(rows), len(parameters.shape)), np.float32)
    longest = follow(path, obstacle, grid, pieces, rows, free, place, along)
    slide(path, obstacle, grid, parameters.bounds, pieces, _count_pieces([longest]), rows, free, place, along)
    stuck = np.flatnonzero(marks == STUCK)
    if len(stuck):
        push_out(path, obstacle, grid, parameters.bounds, stuck)


def keep_clear_of_moving(
    path: Array, mask: Array, parameters: KernelParameters, ahead: Sequence[SolidCache], threads: int
) -> None:
    """`keep_clear` of obstacles that are elsewhere in each frame, frame by frame."""
    steps = np.diff(path, axis=0)
    for frame, solids in enumerate(ahead):
        np.add(path[frame], steps[frame], out=path[frame + 1])
        keep_clear(path[frame : frame + 2], mask, parameters, solids, threads)
        confine_all(path[frame + 1, : len(mask)], parameters.bounds)


def _count_pieces(lengths: list[float]) -> int:
    """Pieces of at most half a cell in the longest of these lengths."""
    return min(max(math.ceil(max(lengths, default=0.0) / PIECE), 1), _MAX_PIECES)


@jit
def longest_step(path: Any, mask: Any, low: Any, high: Any) -> Any:
    """Length of the longest step in a frame; steps of padding, and those that are not finite, do not count."""
    longest, real = ZERO, mask[low:high]
    for frame in range(1, len(path)):
        here, before = path[frame, low:high], path[frame - 1, low:high]
        for p in range(len(here)):
            square = ZERO
            for d in range(here.shape[1]):
                step = here[p, d] - before[p, d]
                square += step * step
            longest = square if real[p] and square > longest and square < _INFINITE else longest
    return np.sqrt(longest)


@jit
def _find_near(path: Any, mask: Any, clearance: Any, grid: Any, begin: Any, end: Any, near: Any) -> Any:
    """Fill in which particles but padding may touch an obstacle, in order, and return how many."""
    count = 0
    furthest, start = np.zeros(end - begin, np.float32), path[0, begin:end]
    for frame in range(1, len(path)):
        here = path[frame, begin:end]
        for d in range(path.shape[2]):
            for p in range(len(here)):
                way = abs(here[p, d] - start[p, d])
                furthest[p] = furthest[p] if way <= furthest[p] else way  # NaN is far
    for p in range(begin, end):
        if mask[p] and not furthest[p - begin] <= clearance[cell_index(path[0], grid, p)] - ONE:
            near[count] = p
            count += 1
    return count


@jit
def mark(
    path: Any, mask: Any, obstacle: Any, clearance: Any, grid: Any, pieces: Any, marks: Any, low: Any, high: Any
) -> Any:
    """Fill in which particles touch an obstacle (`TOUCHES`) or start in one (`STUCK`), and return how many do."""
    dim, touching = path.shape[2], 0
    places, values = np.empty((BLOCK, dim), np.float32), np.empty(BLOCK, np.float32)
    near = np.empty(BLOCK, np.int64)
    marks[low:high] = CLEAR
    for begin in range(low, high, BLOCK):
        count = _find_near(path, mask, clearance, grid, begin, min(begin + BLOCK, high), near)
        for k in range(count):
            for d in range(dim):
                places[k, d] = path[0, near[k], d]
        depths(obstacle, places[:count], grid, values)
        for k in range(count):
            marks[near[k]] = STUCK if values[k] > SURFACE else CLEAR
        for frame in range(1, len(path)):
            for piece in range(pieces):
                part = np.float32(piece) / np.float32(pieces)
                for k in range(count):
                    p = near[k]
                    for d in range(dim):
                        here = path[frame, p, d]
                        places[k, d] = here - (here - path[frame - 1, p, d]) * part
                depths(obstacle, places[:count], grid, values)
                for k in range(count):
                    if values[k] > SURFACE and marks[near[k]] == CLEAR:
                        marks[near[k]] = TOUCHES
        for k in range(count):
            touching += marks[near[k]] != CLEAR
    return touching


@jit
def follow(path: Any, obstacle: Any, grid: Any, pieces: Any, rows: Any, free: Any, place: Any, along: Any) -> Any:
    """Find where particles first get too deep into an obstacle.

    Args:
        pieces: Into how many each frame is cut.
        rows: (n,) the particles.
        free: (n,), is filled: pieces before that.
        place: (n, D), is filled: the last place that is not too deep.
        along: (n, D), is filled: the rest of the way from there without its part into the solid.

    Returns:
        The length of the longest rest; those that are not finite do not count.
    """
    frames, dim, longest = len(path) - 1, path.shape[2], ZERO
    points, values = np.empty((frames * pieces, dim), np.float32), np.empty(frames * pieces, np.float32)
    inward, last = np.empty(dim, np.float32), frames * pieces - 1
    for row in range(len(rows)):
        p = rows[row]
        for k in range(frames * pieces):
            frame, part = k // pieces, np.float32(k % pieces + 1) / np.float32(pieces)
            for d in range(dim):
                before = path[frame, p, d]
                points[k, d] = before + (path[frame + 1, p, d] - before) * part
        depths(obstacle, points, grid, values)
        free[row] = _first_deep(values, len(points))
        _point_inward(obstacle, points[min(free[row], last)], grid, inward)
        into = ZERO
        for d in range(dim):
            place[row, d] = points[free[row] - 1, d] if free[row] > 0 else path[0, p, d]
            into += (path[frames, p, d] - place[row, d]) * inward[d]
        square = ZERO
        for d in range(dim):
            along[row, d] = path[frames, p, d] - place[row, d] - (ZERO if into < ZERO else into) * inward[d]
            square += along[row, d] * along[row, d]
        if square > longest and np.isfinite(square):
            longest = square
    return np.sqrt(longest)


@jit
def slide(
    path: Any, obstacle: Any, grid: Any, bounds: Any, pieces: Any, finer: Any, rows: Any, free: Any, place: Any,
    along: Any,
) -> Any:  # fmt: skip
    """Let particles go on along the surface from where they touch; arguments as of `follow`.

    What is left of the way is gone straight, evenly over the frames left, until the surface bends into it: looked at in
    `finer` pieces.
    """
    frames, dim = len(path) - 1, path.shape[2]
    points, values = np.empty((finer, dim), np.float32), np.empty(finer, np.float32)
    for row in range(len(rows)):
        p = rows[row]
        for k in range(finer):
            for d in range(dim):
                points[k, d] = place[row, d] + along[row, d] * (np.float32(k + 1) / np.float32(finer))
        depths(obstacle, points, grid, values)
        part = np.float32(_first_deep(values, finer)) / np.float32(finer)
        left = np.float32(max(frames * pieces - free[row], 1))
        for frame in range(frames):
            passed = (frame + 1) * pieces - free[row]
            if passed > 0:
                gone = min(np.float32(passed) / left, part)
                for d in range(dim):
                    onward = place[row, d] + along[row, d] * gone
                    path[frame + 1, p, d] = confine(onward, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit
def push_out(path: Any, obstacle: Any, grid: Any, bounds: Any, rows: Any) -> Any:
    """Lead particles straight out of the obstacle that they are in, or to where it is least deep."""
    frames, dim = len(path) - 1, path.shape[2]
    points, values = np.empty((_WAYS_OUT + 1, dim), np.float32), np.empty(_WAYS_OUT + 1, np.float32)
    inward = np.empty(dim, np.float32)
    for p in rows:
        _point_inward(obstacle, path[0, p], grid, inward)
        for k in range(_WAYS_OUT + 1):
            for d in range(dim):
                points[k, d] = path[0, p, d] - inward[d] * np.float32(PIECE * k)
        depths(obstacle, points, grid, values)
        best, is_out = 0, values[0] <= SURFACE
        for k in range(1, _WAYS_OUT + 1):
            if not is_out and (values[k] <= SURFACE or values[k] < values[best]):
                best, is_out = k, values[k] <= SURFACE
        for frame in range(1, frames + 1):
            for d in range(dim):
                part = np.float32(frame) / np.float32(frames)
                place = path[0, p, d] + (points[best, d] - path[0, p, d]) * part
                if not np.isnan(path[frame, p, d]):
                    path[frame, p, d] = confine(place, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit
def _first_deep(values: Any, count: Any) -> Any:
    """Index of the first of `count` values beyond the surface, or that is not a number; `count` where there is none."""
    for k in range(count):
        if not values[k] <= SURFACE:
            return k
    return count


@jit
def _point_inward(obstacle: Any, place: Any, grid: Any, inward: Any) -> Any:
    """Fill in the unit vector (D,) along which the obstacle gets deeper; zero where it is even."""
    dim = len(place)
    ends, values = np.empty((2 * dim, dim), np.float32), np.empty(2 * dim, np.float32)
    for k in range(2 * dim):
        for d in range(dim):
            away = np.float32(PIECE) if k < dim else np.float32(-PIECE)
            ends[k, d] = place[d] + (away if k % dim == d else ZERO)
    depths(obstacle, ends, grid, values)
    square, even = ZERO, True
    for d in range(dim):
        inward[d] = values[d] - values[dim + d]
        square += inward[d] * inward[d]
        even = even and abs(inward[d]) < EVEN
    length = max(np.sqrt(square), np.float32(1e-12))
    for d in range(dim):
        inward[d] = ZERO if even else inward[d] / length
