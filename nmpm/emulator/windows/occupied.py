"""The blocks of cells that particles may read in a bundle, estimated from the grid state that it starts from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from nmpm.emulator.windows.axis import Axis

_SLACK = 3.0  # cells by which particles may leave straight paths at constant velocity,
_FASTER = 1.25  # whose velocities are taken this much larger

ALMOST_ALL = 0.85
"""Share of the blocks from which on it is not worth while to tell them from the others."""

Blocks = NDArray[np.bool_]


def readable_blocks(state: Tensor, materials: int, frames: int, axes: Sequence[Axis]) -> Blocks:
    """(B, *blocks), True where a particle may be in one of the next frames.

    Only an estimate: accelerations are not known before the network has run.

    Args:
        state: (B, C_in, *S) grid state in grid units: the velocities of all materials first, then their volumes.
        materials: M, their number.
        frames: m, frames of a bundle.
        axes: Of the grid.
    """
    dim = len(axes)
    velocities, volumes = slice(materials * dim), slice(materials * dim, materials * (dim + 1))
    highest, lowest = (_extremes(state, axes, reduce) for reduce in (torch.amax, torch.amin))
    scene, *places = np.nonzero((highest[..., volumes] != 0).any(-1))  # also where it is no number
    if len(scene) > ALMOST_ALL * highest[..., 0].size:
        return np.ones(highest.shape[:-1], np.bool_)
    extremes = [highest[(scene, *places)][:, velocities], -lowest[(scene, *places)][:, velocities]]
    found = np.stack(extremes, 1).reshape(-1, 2, materials, dim)
    reach = np.nan_to_num(found, nan=np.inf).max(2)  # (K, 2, D), upwards and downwards
    cells, block = np.array([axis.cells for axis in axes]), np.array([axis.block for axis in axes])
    steps = np.ceil(frames * _FASTER * reach.clip(0, cells) + _SLACK).clip(max=cells)
    low = np.stack(places, -1) * block
    high = np.minimum(low + block, cells) - 1 + steps[:, 0]
    copies = [_fit_boxes(low - steps[:, 1] + shift, high + shift, cells) for shift in _periods(axes)]
    kept, lows, highs = (np.concatenate(values) for values in zip(*copies, strict=True))
    count = [axis.blocks for axis in axes]
    return _fill_boxes((len(state), *count), np.tile(scene, len(copies))[kept], lows // block, highs // block)


def _extremes(state: Tensor, axes: Sequence[Axis], reduce: Callable[[Tensor, int], Tensor]) -> NDArray[np.float64]:
    """(B, *blocks, C) extremes of a grid state (B, C, *S) in each block; axis by axis, the largest strides first."""
    rows = state.movedim(1, -1)
    for index, axis in enumerate(axes, start=1):
        missing = axis.blocks * axis.block - axis.cells
        if missing:
            rows = functional.pad(rows, [0, 0] * (rows.dim() - 1 - index) + [0, missing])
        rows = reduce(rows.unflatten(index, (axis.blocks, axis.block)), index + 1)
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
    change = np.zeros((shape[0], *(count + 1 for count in shape[1:])), np.int32)
    for corner in product((0, 1), repeat=low.shape[-1]):
        place = np.where(corner, high + 1, low)
        np.add.at(change, (scene, *place.T), -1 if sum(corner) % 2 else 1)
    for axis in range(1, change.ndim):
        change = change.cumsum(axis)
    return (change > 0)[(slice(None), *(slice(-1),) * low.shape[-1])]
