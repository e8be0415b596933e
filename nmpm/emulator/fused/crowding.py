"""Kernels that spread overfull cells, as `nmpm.emulator.crowding` and `Advection.uncrowded_path` do.

Arrays are those of one scene: positions (N, D), paths (m, N, D), in cells. Nodes are numbered as in the grid state;
along an axis they lie `stride` apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm._support.jit import jit, jit_sum
from nmpm.emulator.contact import SURFACE
from nmpm.emulator.crowding import CLOSED, MAX_SHIFT, SWEEPS
from nmpm.emulator.fused.contact import depths
from nmpm.emulator.fused.flight import confine, energy
from nmpm.transfer.fused.gather import gather
from nmpm.transfer.fused.scatter import scatter

_BLOCK = 512  # particles: their places stay in the fastest cache
_LINEAR = (0, 0)
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
_CLOSED, _FURTHEST, _SURFACE = np.float32(CLOSED), np.float32(MAX_SHIFT), np.float32(SURFACE)


@jit
def conductances(room: Any, shape: Any, wraps: Any, ratio: Any, faces: Any, inverse: Any) -> Any:
    """Fill in what the sweeps need of a scene.

    Args:
        room: (size,) share of each cell that is not solid.
        shape: Nodes along each axis, a tuple.
        wraps: Whether each is periodic, a tuple.
        ratio: (D,) widths of the cells over that of the first axis.
        faces: (D, size), of the faces from each node to the next along an axis, around its end; is filled.
        inverse: (size,) of the sums of the faces' conductances, 0 in solids; is filled.
    """
    size, stride = len(room), len(room)
    inverse[:] = ZERO
    for axis in range(len(shape)):
        span, stride = stride, stride // shape[axis]
        factor = ONE / (ratio[axis] * ratio[axis])
        for node in range(size):
            is_last = node % span >= span - stride
            other = node - (span - stride) if is_last else node + stride
            closed = is_last and not wraps[axis]
            faces[axis, node] = ZERO if closed else min(room[node], room[other]) * factor
        for node in range(size):
            is_last = node % span >= span - stride
            inverse[node] += faces[axis, node]
            inverse[node - (span - stride) if is_last else node + stride] += faces[axis, node]
    for node in range(size):
        inverse[node] = ONE / inverse[node] if inverse[node] > _CLOSED else ZERO


@jit
def count_particles(cells: Any, mask: Any, shape: Any, wraps: Any, low: Any, high: Any) -> Any:
    """(size, 1) particles `low` to `high` on each node, linearly."""
    size = 1
    for extent in shape:
        size *= extent
    counts = np.zeros((size, 1), np.float32)
    nothing, only = np.empty((high - low, 0), np.float32), np.empty(0, np.int64)
    scatter(nothing, only, mask[low:high], cells[low:high], shape, wraps, _LINEAR, counts)
    return counts


@jit
def push(counts: Any, particle: Any, room: Any, faces: Any, inverse: Any, shape: Any, flow: Any) -> Any:
    """Fill in the displacement at the nodes that spreads overfull cells; whether there are any.

    Args:
        counts: (size,) particles; is changed.
        particle: What one fills of a cell, over the cap.
        room: As for `conductances`.
        faces: From `conductances`.
        inverse: From `conductances`.
        shape: Nodes along each axis, a tuple.
        flow: (size, D), is filled, if there are overfull cells.
    """
    full = False
    for node in range(len(counts)):
        counts[node] = counts[node] * particle - room[node]
        full |= counts[node] > ZERO
    if not full:
        return False
    pressure, left, flux = np.empty_like(counts), np.empty_like(counts), np.empty_like(counts)
    _relax(pressure, inverse, counts, ZERO)
    for _ in range(SWEEPS - 1):
        left[:] = counts
        stride = len(counts)
        for axis in range(len(shape)):
            span, stride = stride, stride // shape[axis]
            _find_flux(pressure, faces[axis], span, stride, flux)
            _add_balance(flux, span, stride, left)
        _relax(pressure, inverse, left, ONE)
    stride = len(counts)
    for axis in range(len(shape)):
        span, stride = stride, stride // shape[axis]
        _find_flux(pressure, faces[axis], span, stride, flux)
        for node in range(len(flux)):
            before = node - stride if node % span >= stride else node + span - stride
            flow[node, axis] = (flux[node] + flux[before]) * HALF
    return True


@jit
def _relax(pressure: Any, inverse: Any, left: Any, kept: Any) -> Any:
    for node in range(len(pressure)):
        value = inverse[node] * left[node]
        if kept > ZERO:
            value += pressure[node]
        pressure[node] = ZERO if value < ZERO else value


@jit
def _find_flux(pressure: Any, face: Any, span: Any, stride: Any, flux: Any) -> Any:
    """Fill in the displacement through the faces from each node to the next along an axis."""
    for first in range(0, len(flux), span):
        last, end = first + span - stride, first + span
        _find_steps(pressure[first:last], pressure[first + stride : end], face[first:last], flux[first:last])
        _find_steps(pressure[last:end], pressure[first : first + stride], face[last:end], flux[last:end])


@jit
def _find_steps(these: Any, those: Any, face: Any, flux: Any) -> Any:
    """Fill in the flux from these nodes to those; of slices, as Numba's check for negative indices is slow."""
    for node in range(len(these)):
        flux[node] = face[node] * (these[node] - those[node])


@jit
def _add_balance(flux: Any, span: Any, stride: Any, left: Any) -> Any:
    """Add to each node what flows in from the one before along an axis, less what flows out."""
    for first in range(0, len(flux), span):
        last, end, second = first + span - stride, first + span, first + stride
        _add_difference(flux[last:end], flux[first:second], left[first:second])
        _add_difference(flux[first:last], flux[second:end], left[second:end])


@jit
def _add_difference(entering: Any, leaving: Any, left: Any) -> Any:
    for node in range(len(left)):
        left[node] += entering[node] - leaving[node]


@jit
def drift(
    flow: Any, path: Any, mask: Any, share: Any, shape: Any, wraps: Any, bounds: Any, spread: Any, low: Any, high: Any
) -> Any:
    """Fill in the path with the displacement at its end spread evenly over its frames.

    Args:
        flow: (size, D), from `push`.
        path: (m, N, D).
        mask: (N,) bool, False for padding, which stays.
        share: (size,) of each cell's room that is obstacle, which nobody is spread into; empty for none.
        shape: Nodes along each axis, a tuple.
        wraps: Whether each is periodic, a tuple.
        bounds: As for `flight.fly`.
        spread: (m, N, D), is filled.
        low: The first particle.
        high: The one after the last.
    """
    frames, dim = path.shape[0], path.shape[2]
    shift, only = np.empty((_BLOCK, dim), np.float32), np.empty(0, np.int64)
    places, values = np.empty((frames, dim), np.float32), np.empty(frames, np.float32)
    for begin in range(low, high, _BLOCK):
        end = min(begin + _BLOCK, high)
        gather(flow, only, path[frames - 1, begin:end], shape, wraps, _LINEAR, shift)
        for p in range(end - begin):
            for d in range(dim):
                way = shift[p, d] if mask[begin + p] else ZERO
                way = _FURTHEST if way > _FURTHEST else way
                shift[p, d] = -_FURTHEST if way < -_FURTHEST else way
        for frame in range(frames):
            part = np.float32(frame + 1) / np.float32(frames)
            here, moved = path[frame, begin:end], spread[frame, begin:end]
            for d in range(dim):
                lowest, highest, reflects = bounds[0, d], bounds[1, d], bounds[2, d] > ZERO
                for p in range(len(here)):
                    moved[p, d] = confine(here[p, d] + part * shift[p, d], lowest, highest, reflects)
        if len(share):
            _take_back(path, share, (shape, wraps), shift, begin, end, places, values, spread)


@jit
def _take_back(
    path: Any, share: Any, grid: Any, shift: Any, begin: Any, end: Any, places: Any, values: Any, spread: Any
) -> Any:
    """Leave particles on their path that would be spread into an obstacle."""
    for p in range(begin, end):
        moves = False
        for d in range(path.shape[2]):
            moves |= shift[p - begin, d] != ZERO
        if not moves:
            continue
        places[:] = spread[:, p]
        depths(share, places, grid, values)
        if (values > _SURFACE).any():
            spread[:, p] = path[:, p]


@jit
def spread_energies(
    cells: Any, path: Any, spread: Any, gravity: Any, share: Any, ratio: Any, low: Any, high: Any
) -> Any:
    """Energies (m + 1,) of the frames of a spread path, and of its end with the velocity of the path's end.

    Args:
        cells: (N, D) positions at the bundle's start.
        path: (m, N, D).
        spread: (m, N, D).
        gravity: (D,), what a frame adds to a velocity.
        share: (N,) of the scene's mass.
        ratio: (D,) widths of the cells over that of the first axis.
        low: The first particle.
        high: The one after the last.
    """
    frames = len(path)
    energies = np.zeros(frames + 1)
    for begin in range(low, high, _BLOCK):
        end = min(begin + _BLOCK, high)
        for frame in range(frames):
            before = spread[frame - 1, begin:end] if frame > 0 else cells[begin:end]
            energies[frame] += energy(spread[frame, begin:end], before, gravity, share[begin:end], ratio)
        last = path[frames - 2, begin:end] if frames > 1 else cells[begin:end]
        energies[frames] += _end_energy(
            spread[frames - 1, begin:end], path[frames - 1, begin:end], last, gravity, share[begin:end], ratio
        )
    return energies


@jit_sum
def _end_energy(spread: Any, arrived: Any, before: Any, gravity: Any, share: Any, ratio: Any) -> Any:
    """Energy of particles at `spread` with the step from `before` to `arrived`, weighted by their shares."""
    total = ZERO
    for d in range(spread.shape[1]):
        fall, wide = gravity[d] * ratio[d] * ratio[d], HALF * ratio[d] * ratio[d]
        for p in range(len(spread)):
            step = arrived[p, d] - before[p, d]
            total += share[p] * (wide * step * step - spread[p, d] * fall)
    return np.float64(total)
