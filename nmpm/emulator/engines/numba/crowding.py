"""Overfull cells spread into the room around them: as the torch engine's `crowding` computes.

Nodes are numbered as in the grid state; along an axis they lie `stride` apart.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from nmpm._support.jit import jit
from nmpm._support.threads import map_ranges, split
from nmpm.emulator.engines.numba.gather import ANYBODY, depths, gather
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.numba.path import BLOCK, CHUNK, ROUNDING, confine, energy, fill_mass
from nmpm.emulator.engines.numba.scatter import scatter
from nmpm.emulator.engines.numba.solids import FreeVolume, SolidCache
from nmpm.emulator.engines.numba.state import StartArrays
from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.emulator.engines.torch.crowding import MAX_SHIFT, SWEEPS

_COUNTED = 2**16  # particles of a chunk that is counted: each has a grid of its own
_NONE = np.empty(0, np.float32)
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
_FURTHEST, _SURFACE = np.float32(MAX_SHIFT), np.float32(SURFACE)


def spread_crowds(
    start: StartArrays, parameters: KernelParameters, solids: SolidCache, budget: float | None, threads: int
) -> None:
    """Change the path of a scene so that its overfull cells spread, within the energy `budget` if there is one."""
    path, flow = start.path, _find_flow(start, parameters, solids.free, threads)
    if flow is None:
        return
    obstacle, spread = solids.obstacle if parameters.solids else _NONE, np.empty_like(path)
    spread[0] = path[0]
    move = partial(drift, flow, path, start.mask, obstacle, parameters.grid, parameters.bounds, spread)
    map_ranges(move, split(len(start.mask), CHUNK), threads)
    share = 1.0 if budget is None else _affordable_share(start, spread, parameters, budget, threads)
    path, spread = path[1:, : len(start.mask)], spread[1:, : len(start.mask)]
    path[:] = spread if share == 1 else path + np.float32(share) * (spread - path)


def _find_flow(start: StartArrays, parameters: KernelParameters, free: FreeVolume | None, threads: int) -> Array | None:
    """(size, D) displacements at the nodes; None where no cell is overfull."""
    if free is None or not len(start.mask):
        return None
    count = partial(count_particles, start.path[-1], start.mask, start.volume, parameters.grid)
    parts = map_ranges(count, split(len(start.mask), max(_COUNTED, 4 * parameters.size)), threads)
    counts = parts[0]
    for part in parts[1:]:
        counts += part
    flow = np.empty((parameters.size, len(parameters.shape)), np.float32)
    particle = np.float32(parameters.particle_volume / parameters.density_cap)
    full = push(
        np.ascontiguousarray(counts[:, 0]), particle, free.room, free.faces, free.inverse, parameters.shape, flow
    )
    return flow if full else None


def _affordable_share(
    start: StartArrays, spread: Array, parameters: KernelParameters, budget: float, threads: int
) -> float:
    """The part of the way to the spread path that no frame's energy forbids, see the torch engine's `energy`."""
    path, mass = start.path, np.empty(len(start.mask), np.float32)
    fill_mass(start.material, start.mask, start.volume, parameters.mass, mass)

    def energies(of: Array) -> Array:
        find = partial(spread_energies, path, of, start.gravity, mass, parameters.ratio)
        return np.asarray(np.sum(map_ranges(find, split(len(start.mask), CHUNK), threads), axis=0))

    after = energies(spread)
    exceeds = after > budget + ROUNDING * abs(budget)
    if not exceeds.any():
        return 1.0
    before = energies(path)
    rise, room = after[exceeds] - before[exceeds], np.maximum(budget - before[exceeds], 0)
    return float(np.where(rise > 0, room / np.where(rise > 0, rise, 1), 0).min())


@jit
def count_particles(cells: Any, mask: Any, volume: Any, grid: Any, low: Any, high: Any) -> Any:
    """(size, 1) or (size, 2), whose first column has the particles `low` to `high` on each node, by volume."""
    size = 1
    for extent in grid[0]:
        size *= extent
    width = 1 if len(volume) else 0
    counts, values = np.zeros((size, width + 1), np.float32), np.empty((high - low, width), np.float32)
    if width:
        values[:, 0] = volume[low:high]
    scatter(values, ANYBODY, mask[low:high], cells[low:high], grid, counts)
    return counts


@jit
def push(counts: Any, particle: Any, room: Any, faces: Any, inverse: Any, shape: Any, flow: Any) -> Any:
    """Fill in the displacement at the nodes that spreads overfull cells; whether there are any.

    Args:
        counts: (size,) particles; is changed.
        particle: What one fills of a cell, over the cap.
        room, faces, inverse: Of a `FreeVolume`.
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
    flow: Any, path: Any, mask: Any, obstacle: Any, grid: Any, bounds: Any, spread: Any, low: Any, high: Any
) -> Any:
    """Fill in `spread` (m, N, D), the path with the displacement by `flow` (size, D) at its end spread over its frames.

    Padding stays, and nobody is spread into the obstacle.
    """
    frames, dim = path.shape[0] - 1, path.shape[2]
    shift = np.empty((BLOCK, dim), np.float32)
    places, values = np.empty((frames, dim), np.float32), np.empty(frames, np.float32)
    for begin in range(low, high, BLOCK):
        end = min(begin + BLOCK, high)
        gather(flow, ANYBODY, path[frames, begin:end], grid, grid[0], shift)
        for p in range(end - begin):
            for d in range(dim):
                way = shift[p, d] if mask[begin + p] else ZERO
                way = _FURTHEST if way > _FURTHEST else way
                shift[p, d] = -_FURTHEST if way < -_FURTHEST else way
        for frame in range(1, frames + 1):
            part = np.float32(frame) / np.float32(frames)
            here, moved = path[frame, begin:end], spread[frame, begin:end]
            for d in range(dim):
                lowest, highest, reflects = bounds[0, d], bounds[1, d], bounds[2, d] > ZERO
                for p in range(len(here)):
                    moved[p, d] = confine(here[p, d] + part * shift[p, d], lowest, highest, reflects)
        if len(obstacle):
            _take_back(path, obstacle, grid, shift, begin, end, places, values, spread)


@jit
def _take_back(
    path: Any, obstacle: Any, grid: Any, shift: Any, begin: Any, end: Any, places: Any, values: Any, spread: Any
) -> Any:
    """Leave particles on their path that would be spread into an obstacle."""
    for p in range(begin, end):
        moves = False
        for d in range(path.shape[2]):
            moves |= shift[p - begin, d] != ZERO
        if not moves:
            continue
        places[:] = spread[1:, p]
        depths(obstacle, places, grid, values)
        if (values > _SURFACE).any():
            spread[1:, p] = path[1:, p]


@jit
def spread_energies(path: Any, spread: Any, gravity: Any, mass: Any, ratio: Any, low: Any, high: Any) -> Any:
    """Energies (m + 1,) of the frames of a spread path, and of its end with the velocity of the path's end."""
    frames = len(path) - 1
    energies = np.zeros(frames + 1)
    for begin in range(low, high, BLOCK):
        end = min(begin + BLOCK, high)
        for frame in range(frames):
            here, before = spread[frame + 1, begin:end], spread[frame, begin:end]
            energies[frame] += energy(here, here, before, gravity, mass[begin:end], ratio)
        last, end_of_path = path[frames - 1, begin:end], path[frames, begin:end]
        energies[frames] += energy(spread[frames, begin:end], end_of_path, last, gravity, mass[begin:end], ratio)
    return energies
