"""The blocks of cells that particles may read in a bundle, estimated from the grid state that it starts from."""

from __future__ import annotations

from collections.abc import Sequence
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
_FAST = 1e9  # stands for speeds that are not finite
_POOLS = {1: functional.max_pool1d, 2: functional.max_pool2d, 3: functional.max_pool3d}

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
    velocity, volume = state[:, : materials * dim], state[:, materials * dim : materials * (dim + 1)]
    full = (volume != 0).any(1, keepdim=True).to(state.dtype)
    values = torch.cat([full, velocity, -velocity], dim=1)
    pooled = _POOLS[dim](values, [axis.block for axis in axes], ceil_mode=True)
    numbers = pooled.nan_to_num(_FAST).clamp(-_FAST, _FAST).double().cpu().numpy()
    fastest = numbers[:, 1:].reshape(len(state), 2, materials, dim, *numbers.shape[2:]).max(2)
    scene, *places = np.nonzero(numbers[:, 0])
    reach = np.moveaxis(fastest, (1, 2), (-2, -1))[(scene, *places)]  # (K, 2, D), upwards and downwards
    extent = [3 * axis.blocks if axis.periodic else axis.blocks for axis in axes]
    lows, highs = [], []
    for index, axis in enumerate(axes):
        steps = np.clip(frames * _FASTER * np.maximum(reach[..., index], 0) + _SLACK, 0, axis.cells)
        low, high = _reached(axis, places[index], steps[:, 1], steps[:, 0])
        lows.append(low)
        highs.append(high)
    boxes = _fill_boxes((len(state), *extent), scene, lows, highs)
    for index, axis in enumerate(axes, start=1):
        if axis.periodic:  # from three periods to one
            folded = boxes.reshape(*boxes.shape[:index], 3, axis.blocks, *boxes.shape[index + 1 :])
            boxes = np.asarray(folded.any(index))
    return boxes


def _reached(axis: Axis, block: Any, down: Any, up: Any) -> tuple[Any, Any]:
    """First and last block, inclusive, that cells of a block reach; on periodic axes among three periods."""
    low = np.floor((block * axis.block - down) / axis.block).astype(np.int64)
    high = np.floor((block * axis.block + (axis.block - 1) + up) / axis.block).astype(np.int64)
    if axis.periodic:
        return low + axis.blocks, high + axis.blocks
    return np.maximum(low, 0), np.minimum(high, axis.blocks - 1)


def _fill_boxes(shape: tuple[int, ...], scene: Any, lows: list[Any], highs: list[Any]) -> Blocks:
    """(B, *extent), True in the boxes from lows to highs, inclusive, by sums of differences at their corners."""
    change = np.zeros((shape[0], *(cells + 1 for cells in shape[1:])), np.int32)
    for corner in product((0, 1), repeat=len(lows)):
        place = [high + 1 if upper else low for upper, low, high in zip(corner, lows, highs, strict=True)]
        np.add.at(change, (scene, *place), -1 if sum(corner) % 2 else 1)
    for axis in range(1, change.ndim):
        change = change.cumsum(axis)
    return (change > 0)[(slice(None), *(slice(0, -1),) * len(lows))]
