"""Kernels that keep particles out of obstacles, as `nmpm.emulator.contact` does on a CPU.

Arrays are those of one scene; `share` (size,) is the share of each cell's room that is obstacle, `grid` the tuple of
shape and periodic axes. Particles are marked that touch an obstacle, then only those are followed piece by piece.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm.emulator.fused.flight import confine
from nmpm.transfer.fused.gather import bilinear
from nmpm.transfer.fused.nodes import linear_nodes

SURFACE, PIECE, EVEN = 0.4, 0.5, 1e-5  # as in `nmpm.emulator.contact`
CLEAR, TOUCHES, STUCK = 0, 1, 2
FAR = 16
"""Cells beyond which clearances are not told apart."""

_WAYS_OUT = 4
_BLOCK = 512
ZERO, ONE, _INFINITE = np.float32(0), np.float32(1), np.float32(np.inf)


@jit
def fill_share(solid: Any, walls: Any, share: Any) -> Any:
    """Fill in the share of each cell's room that is obstacle, from those that are solid and wall."""
    for node in range(len(share)):
        room = ONE - walls[node]
        part = (solid[node] - walls[node]) / max(room, np.float32(1e-6)) if room > ZERO else ZERO
        share[node] = ZERO if part < ZERO else (ONE if part > ONE else part)


@jit
def depths(share: Any, places: Any, grid: Any, out: Any) -> Any:
    """Fill in the share (K,) at places (K, D), interpolated linearly."""
    shape, wraps = grid
    for k in range(len(places)):
        i0, i1, x = linear_nodes(places[k, 0], shape[0], wraps[0])
        j0, j1, y = linear_nodes(places[k, 1], shape[1], wraps[1])
        a, b, c, d = i0 * shape[1] + j0, i0 * shape[1] + j1, i1 * shape[1] + j0, i1 * shape[1] + j1
        if len(shape) == 2:
            out[k] = bilinear(share[a], share[b], share[c], share[d], x, y)
        else:
            last, n = len(shape) - 1, shape[len(shape) - 1]
            k0, k1, z = linear_nodes(places[k, last], n, wraps[last])
            low = bilinear(share[a * n + k0], share[b * n + k0], share[c * n + k0], share[d * n + k0], x, y)
            high = bilinear(share[a * n + k1], share[b * n + k1], share[c * n + k1], share[d * n + k1], x, y)
            out[k] = (ONE - z) * low + z * high


@jit
def longest_step(cells: Any, path: Any, mask: Any, low: Any, high: Any) -> Any:
    """Length of the longest step of particles `low` to `high` in a frame.

    Steps of padding, and those that are not finite, do not count.
    """
    longest, real = ZERO, mask[low:high]
    for frame in range(len(path)):
        here = path[frame, low:high]
        before = path[frame - 1, low:high] if frame > 0 else cells[low:high]
        for p in range(len(here)):
            square = ZERO
            for d in range(here.shape[1]):
                step = here[p, d] - before[p, d]
                square += step * step
            longest = square if real[p] and square > longest and square < _INFINITE else longest
    return np.sqrt(longest)


@jit
def widen(marked: Any, shape: Any, wraps: Any, axis: Any) -> Any:
    """(size,) bool: whether a cell or one beside it along an axis is marked."""
    stride, extent = 1, shape[axis]
    for d in range(axis + 1, len(shape)):
        stride *= shape[d]
    wide = np.empty_like(marked)
    for node in range(len(marked)):
        row = node // stride % extent
        below = row > 0 or wraps[axis]
        above = row < extent - 1 or wraps[axis]
        lower = node - stride if row > 0 else node + (extent - 1) * stride
        upper = node + stride if row < extent - 1 else node - (extent - 1) * stride
        wide[node] = marked[node] or (below and marked[lower]) or (above and marked[upper])
    return wide


@jit
def fill_clearance(share: Any, grid: Any, clearance: Any) -> Any:
    """Fill in how far each cell (size,) is from those in which a particle may touch an obstacle: 0 there, at most FAR.

    Along each axis: a particle that moves no further than one cell less along any axis touches nothing.
    """
    shape, wraps = grid
    near = share > np.float32(SURFACE)
    clearance[:] = np.float32(FAR)
    for distance in range(-1, FAR):  # a particle's depth is interpolated from the cells beside its own
        for node in range(len(near)):
            if near[node] and distance >= 0:
                clearance[node] = min(clearance[node], np.float32(distance))
        for axis in range(len(shape)):
            near = widen(near, shape, wraps, axis)


@jit
def _find_near(cells: Any, path: Any, mask: Any, clearance: Any, grid: Any, begin: Any, end: Any, near: Any) -> Any:
    """Fill in which particles may touch an obstacle, in order, and return how many.

    Never padding; all others, without clearances.
    """
    shape, wraps = grid
    found = 0
    if len(clearance) == 0:
        for p in range(begin, end):
            if mask[p]:
                near[found] = p
                found += 1
        return found
    furthest, start = np.zeros(end - begin, np.float32), cells[begin:end]
    for frame in range(len(path)):
        here = path[frame, begin:end]
        for d in range(len(shape)):
            for p in range(len(here)):
                way = abs(here[p, d] - start[p, d])
                furthest[p] = furthest[p] if way <= furthest[p] else way  # NaN is far
    for p in range(begin, end):
        node = 0
        for d in range(len(shape)):
            row = np.int64(np.floor(cells[p, d])) if np.isfinite(cells[p, d]) else 0
            node = node * shape[d] + (row % shape[d] if wraps[d] else min(max(row, 0), shape[d] - 1))
        if mask[p] and not furthest[p - begin] <= clearance[node] - ONE:
            near[found] = p
            found += 1
    return found


@jit
def mark(
    cells: Any, path: Any, mask: Any, share: Any, clearance: Any, grid: Any, pieces: Any, marks: Any, low: Any,
    high: Any,
) -> Any:  # fmt: skip
    """Fill in which particles touch an obstacle (`TOUCHES`) or start in one (`STUCK`), and return how many do."""
    dim, found = cells.shape[1], 0
    places, values = np.empty((_BLOCK, dim), np.float32), np.empty(_BLOCK, np.float32)
    near = np.empty(_BLOCK, np.int64)
    marks[low:high] = CLEAR
    for begin in range(low, high, _BLOCK):
        count = _find_near(cells, path, mask, clearance, grid, begin, min(begin + _BLOCK, high), near)
        for k in range(count):
            for d in range(dim):
                places[k, d] = cells[near[k], d]
        depths(share, places[:count], grid, values)
        for k in range(count):
            marks[near[k]] = STUCK if values[k] > SURFACE else CLEAR
        for frame in range(len(path)):
            for piece in range(pieces):
                part = np.float32(piece) / np.float32(pieces)
                for k in range(count):
                    p = near[k]
                    for d in range(dim):
                        here = path[frame, p, d]
                        before = path[frame - 1, p, d] if frame > 0 else cells[p, d]
                        places[k, d] = here - (here - before) * part
                depths(share, places[:count], grid, values)
                for k in range(count):
                    if values[k] > SURFACE and marks[near[k]] == CLEAR:
                        marks[near[k]] = TOUCHES
        for k in range(count):
            found += marks[near[k]] != CLEAR
    return found


@jit
def follow(
    cells: Any, path: Any, share: Any, grid: Any, pieces: Any, rows: Any, free: Any, place: Any, along: Any
) -> Any:
    """Find where particles first get too deep into an obstacle.

    Args:
        cells: (N, D) of the scene.
        path: (m, N, D) of the scene.
        share: (size,) of the scene.
        grid: Shape and periodic axes.
        pieces: Into how many each frame is cut.
        rows: (n,) the particles.
        free: (n,), is filled: pieces before that.
        place: (n, D), is filled: the last place that is not too deep.
        along: (n, D), is filled: the rest of the way from there without its part into the solid.

    Returns:
        The length of the longest rest; those that are not finite do not count.
    """
    frames, dim, longest = len(path), cells.shape[1], ZERO
    points, values = np.empty((frames * pieces, dim), np.float32), np.empty(frames * pieces, np.float32)
    inward, last = np.empty(dim, np.float32), frames * pieces - 1
    for row in range(len(rows)):
        p = rows[row]
        for k in range(frames * pieces):
            frame, part = k // pieces, np.float32(k % pieces + 1) / np.float32(pieces)
            for d in range(dim):
                before = path[frame - 1, p, d] if frame > 0 else cells[p, d]
                points[k, d] = before + (path[frame, p, d] - before) * part
        depths(share, points, grid, values)
        free[row] = _first_deep(values, len(points))
        _point_inward(share, points[min(free[row], last)], grid, inward)
        into = ZERO
        for d in range(dim):
            place[row, d] = points[free[row] - 1, d] if free[row] > 0 else cells[p, d]
            into += (path[frames - 1, p, d] - place[row, d]) * inward[d]
        square = ZERO
        for d in range(dim):
            along[row, d] = path[frames - 1, p, d] - place[row, d] - (ZERO if into < ZERO else into) * inward[d]
            square += along[row, d] * along[row, d]
        if square > longest and np.isfinite(square):
            longest = square
    return np.sqrt(longest)


@jit
def slide(
    path: Any, share: Any, grid: Any, bounds: Any, pieces: Any, finer: Any, rows: Any, free: Any, place: Any, along: Any
) -> Any:
    """Let particles go on along the surface from where they touch; arguments as of `follow`.

    What is left of the way is gone straight, evenly over the frames left, until the surface bends into it: looked at in
    `finer` pieces.
    """
    frames, dim = len(path), path.shape[2]
    points, values = np.empty((finer, dim), np.float32), np.empty(finer, np.float32)
    for row in range(len(rows)):
        p = rows[row]
        for k in range(finer):
            for d in range(dim):
                points[k, d] = place[row, d] + along[row, d] * (np.float32(k + 1) / np.float32(finer))
        depths(share, points, grid, values)
        part = np.float32(_first_deep(values, finer)) / np.float32(finer)
        left = np.float32(max(frames * pieces - free[row], 1))
        for frame in range(frames):
            passed = (frame + 1) * pieces - free[row]
            if passed > 0:
                gone = min(np.float32(passed) / left, part)
                for d in range(dim):
                    onward = place[row, d] + along[row, d] * gone
                    path[frame, p, d] = confine(onward, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit
def push_out(cells: Any, path: Any, share: Any, grid: Any, bounds: Any, rows: Any) -> Any:
    """Lead particles straight out of the obstacle that they are in, or to where it is least deep."""
    frames, dim = len(path), cells.shape[1]
    points, values = np.empty((_WAYS_OUT + 1, dim), np.float32), np.empty(_WAYS_OUT + 1, np.float32)
    inward = np.empty(dim, np.float32)
    for p in rows:
        _point_inward(share, cells[p], grid, inward)
        for k in range(_WAYS_OUT + 1):
            for d in range(dim):
                points[k, d] = cells[p, d] - inward[d] * np.float32(PIECE * k)
        depths(share, points, grid, values)
        best, found = 0, values[0] <= SURFACE
        for k in range(1, _WAYS_OUT + 1):
            if not found and (values[k] <= SURFACE or values[k] < values[best]):
                best, found = k, values[k] <= SURFACE
        for frame in range(frames):
            for d in range(dim):
                part = np.float32(frame + 1) / np.float32(frames)
                place = cells[p, d] + (points[best, d] - cells[p, d]) * part
                path[frame, p, d] = confine(place, bounds[0, d], bounds[1, d], bounds[2, d] > ZERO)


@jit
def _first_deep(values: Any, count: Any) -> Any:
    """Index of the first of `count` values beyond the surface, or that is not a number; `count` where there is none."""
    for k in range(count):
        if not values[k] <= SURFACE:
            return k
    return count


@jit
def _point_inward(share: Any, place: Any, grid: Any, inward: Any) -> Any:
    """Fill in the unit vector (D,) along which the obstacle gets deeper; zero where it is even."""
    dim = len(place)
    ends, values = np.empty((2 * dim, dim), np.float32), np.empty(2 * dim, np.float32)
    for k in range(2 * dim):
        for d in range(dim):
            away = np.float32(PIECE) if k < dim else np.float32(-PIECE)
            ends[k, d] = place[d] + (away if k % dim == d else ZERO)
    depths(share, ends, grid, values)
    square, even = ZERO, True
    for d in range(dim):
        inward[d] = values[d] - values[dim + d]
        square += inward[d] * inward[d]
        even = even and abs(inward[d]) < EVEN
    length = max(np.sqrt(square), np.float32(1e-12))
    for d in range(dim):
        inward[d] = ZERO if even else inward[d] / length
