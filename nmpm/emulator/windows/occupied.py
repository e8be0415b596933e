"""The blocks of cells that particles may read in a bundle, estimated from the grid state that it starts from."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from nmpm.emulator.windows.axis import BLOCK, Axis

_SLACK = 3.0  # cells by which particles may leave straight paths at constant velocity,
_FASTER = 1.25  # whose velocities are taken this much larger

WORTHWHILE = 0.85
"""Part of the grid's cells that windows may have in all; with more, planning and gathering them does not pay."""

Blocks = NDArray[np.bool_]


def readable_blocks(state: Tensor, materials: int, frames: int, axes: Sequence[Axis]) -> Blocks:
    """(B, *blocks), True where a particle may be in one of the next frames.

    Only an estimate: accelerations are not known before the network has run. True everywhere where windows of fewer
    blocks would not be worth while.

    Args:
        state: (B, C_in, *S) grid state in grid units: the velocities of all materials first, then their volumes.
        materials: M, their number.
        frames: m, frames of a bundle.
        axes: Of the grid.
    """
    dim = len(axes)
    velocities, volumes = slice(materials * dim), slice(materials * dim, materials * (dim + 1))
    highest, lowest = (_extremes(state, axes, reduce) for reduce in (torch.amax, torch.amin))
    occupied = (highest[..., volumes] != 0).any(-1)  # also where it is no number
    if count_needed(occupied, axes) > WORTHWHILE * state[:, 0].numel():
        return np.ones_like(occupied)
    scene, *places = np.nonzero(occupied)
    extremes = [highest[(scene, *places)][:, velocities], -lowest[(scene, *places)][:, velocities]]
    found = np.stack(extremes, 1).reshape(-1, 2, materials, dim)
    reach = np.nan_to_num(found, nan=np.inf).max(2)  # (K, 2, D), upwards and downwards
    cells = np.array([axis.cells for axis in axes])
    steps = np.ceil(frames * _FASTER * reach.clip(0, cells) + _SLACK).clip(max=cells)
    low = np.stack(places, -1) * BLOCK
    high = np.minimum(low + BLOCK, cells) - 1 + steps[:, 0]
    copies = [_fit_boxes(low - steps[:, 1] + shift, high + shift, cells) for shift in _periods(axes)]
    kept, lows, highs = (np.concatenate(values) for values in zip(*copies, strict=True))
    return _fill_boxes(occupied.shape, np.tile(scene, len(copies))[kept], lows // BLOCK, highs // BLOCK)


def count_needed(occupied: Blocks, axes: Sequence[Axis]) -> int:
    """About how many cells the occupied blocks (B, *blocks) and their halos have: windows have no fewer."""
    occupied = dilate(occupied, axes, [axis.halo // BLOCK * BLOCK for axis in axes])
    return int(occupied.sum()) * math.prod(min(BLOCK, axis.cells) for axis in axes)


def dilate(blocks: Blocks, axes: Sequence[Axis], cells: Sequence[int]) -> Blocks:
    """(B, *blocks), True in blocks that have cells up to so many cells from a marked block, along each axis."""
    for index, (axis, distance) in enumerate(zip(axes, cells, strict=True), start=1):
        reach = min(-(-distance // BLOCK), axis.blocks)
        pads = [(0, 0)] * blocks.ndim
        pads[index] = (reach + 1, reach)
        padded = np.pad(blocks, pads, mode="wrap" if axis.periodic else "constant")
        sums = np.moveaxis(padded.cumsum(index, dtype=np.int32), index, -1)
        blocks = np.moveaxis(sums[..., 2 * reach + 1 :] > sums[..., : axis.blocks], -1, index)
    return blocks


def _extremes(state: Tensor, axes: Sequence[Axis], reduce: Callable[[Tensor, int], Tensor]) -> NDArray[np.float64]:
    """(B, *blocks, C) extremes of a grid state (B, C, *S) in each block; axis by axis, the largest strides first."""
    rows = state.movedim(1, -1)
    for index, axis in enumerate(axes, start=1):
        missing = axis.blocks * BLOCK - axis.cells
        if missing:
            rows = functional.pad(rows, [0, 0] * (rows.dim() - 1 - index) + [0, missing])
        rows = reduce(rows.unflatten(index, (axis.blocks, BLOCK)), index + 1)
    return rows.double().cpu().numpy()


def _periods(axes: Sequence[Axis]) -> list[Any]:
    """Shifts (D,) by -1, 0 and 1 periods along each periodic axis, in cells."""
    sides = [(-axis.cells, 0, axis.cells) if axis.periodic else (0,) for axis in axes]
    return [np.array(shift) for shift in product(*sides)]


def _fit_boxes(low: Any, high: Any, cells: Any) -> tuple[Any, Any, Any]:
    """Which boxes of cells (K, D), the highest inclusive, are in the grid, and the parts (K', D) of them that are."""
    kept = ((high >= 0) & (low < cells)).all(-1)
    return kept, np.maximum(low[kept], 0).astype(np.int64), np.minimum(high[kept], cells - 1).astype(np.int64)


def _fill_boxes(shape: tuple[int, ...], scene: Any, low: Any, high: Any) -> Blocks:
    """(B, *blocks), True in boxes of blocks (K, D), the highest inclusive, by sums of differences at their corners."""
    ends = (shape[0], *(count + 1 for count in shape[1:]))
    change = np.zeros(ends, np.int64)
    for corner in product((0, 1), repeat=low.shape[-1]):
        place = np.where(corner, high + 1, low)
        count = np.bincount(np.ravel_multi_index((scene, *place.T), ends), minlength=change.size).reshape(ends)
        change += -count if sum(corner) % 2 else count
    for axis in range(1, change.ndim):
        change = change.cumsum(axis)
    return (change > 0)[(slice(None), *(slice(-1),) * low.shape[-1])]
