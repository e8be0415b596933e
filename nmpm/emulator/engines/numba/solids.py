"""What the kernels know of a scene's solids, prepared once for a rollout, as nothing in it changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from nmpm._support.jit import jit
from nmpm.emulator.engines.numba.arrays import as_array
from nmpm.emulator.engines.numba.parameters import Array, KernelParameters
from nmpm.emulator.engines.torch.contact import SURFACE, obstacle_share
from nmpm.emulator.engines.torch.crowding import CLOSED

FAR = 16
"""Cells beyond which clearances are not told apart."""

ZERO, ONE = np.float32(0), np.float32(1)


@dataclass(frozen=True)
class FreeVolume:
    """Where overfull cells spread to.

    Args:
        room: (size,) share of each cell that is not solid.
        faces: (D, size) conductances of the faces from each node to the next along an axis, around its end.
        inverse: (size,) one over the sum of the conductances of a cell's faces; 0 in solids.
    """

    room: Array
    faces: Array
    inverse: Array


@dataclass(frozen=True)
class SolidCache:
    """The solids of one scene.

    Args:
        obstacle: (size,), see `nmpm.emulator.engines.numba`.
        clearance: (size,) cells, from `fill_clearance`; empty where there are no obstacles.
        free: Where crowding is limited.
    """

    obstacle: Array
    clearance: Array
    free: FreeVolume | None


def prepare_solids(parameters: KernelParameters, solid: Tensor, walls: Tensor) -> tuple[SolidCache, ...]:
    """The solids of each scene, from the shares of each cell that are solid (B, C_solid, *S) and wall (*S)."""
    return tuple(_prepare_scene(parameters, scene, walls) for scene in solid)


def _prepare_scene(parameters: KernelParameters, solid: Tensor, walls: Tensor) -> SolidCache:
    obstacle = clearance = np.empty(0, np.float32)
    if parameters.obstacles:
        obstacle = as_array(obstacle_share(solid, walls)).reshape(-1)
        clearance = np.empty_like(obstacle)
        fill_clearance(obstacle, parameters.grid, clearance)
    room = 1 - as_array(solid if len(solid) else walls).reshape(-1)
    if not parameters.density_cap:
        return SolidCache(obstacle, clearance, None)
    faces, inverse = np.empty((len(parameters.shape), len(room)), np.float32), np.empty_like(room)
    fill_conductances(room, parameters.shape, parameters.wraps, parameters.ratio, faces, inverse)
    return SolidCache(obstacle, clearance, FreeVolume(room, faces, inverse))


@jit
def cell_index(cells: Any, grid: Any, p: Any) -> Any:
    """The index of the cell that particle p is in; of the first along an axis where its position is not finite."""
    shape, wraps, _ = grid
    node = np.int64(0)
    for d in range(len(shape)):
        row = np.int64(np.floor(cells[p, d])) if np.isfinite(cells[p, d]) else 0
        node = node * shape[d] + (row % shape[d] if wraps[d] else min(max(row, 0), shape[d] - 1))
    return node


@jit
def stride_of(shape: Any, axis: Any) -> Any:
    """How far neighbours along an axis are apart in arrays of all cells."""
    stride = 1
    for d in range(axis + 1, len(shape)):
        stride *= shape[d]
    return stride


@jit
def widen(marked: Any, shape: Any, wraps: Any, axis: Any) -> Any:
    """(size,) bool: whether a cell or one beside it along an axis is marked."""
    stride, extent = stride_of(shape, axis), shape[axis]
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
def fill_clearance(obstacle: Any, grid: Any, clearance: Any) -> Any:
    """Fill in how far each cell is from those in which a particle may touch an obstacle: 0 there, at most FAR.

    Along each axis: a particle that moves no further than one cell less along any axis touches nothing.
    """
    shape, wraps, _ = grid
    near = obstacle > np.float32(SURFACE)
    clearance[:] = np.float32(FAR)
    for distance in range(-1, FAR):  # a particle's depth is interpolated from the cells beside its own
        for node in range(len(near)):
            if near[node] and distance >= 0:
                clearance[node] = min(clearance[node], np.float32(distance))
        for axis in range(len(shape)):
            near = widen(near, shape, wraps, axis)


@jit
def fill_conductances(room: Any, shape: Any, wraps: Any, ratio: Any, faces: Any, inverse: Any) -> Any:
    """Fill in the faces and inverses of a `FreeVolume`."""
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
        inverse[node] = ONE / inverse[node] if inverse[node] > np.float32(CLOSED) else ZERO
