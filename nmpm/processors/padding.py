"""Padding grids to sizes that a network can take, and cropping them back."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.grid import Grid


def pad_to_multiple(grid: Tensor, multiple: int) -> Tensor:
    """Extend each space axis of (B, C, *S) at its upper end to a multiple of cells, repeating the last one."""
    for axis in range(2, grid.dim()):
        missing = -grid.shape[axis] % multiple
        if missing:
            last = grid.narrow(axis, grid.shape[axis] - 1, 1)
            grid = torch.cat([grid, last.expand(*grid.shape[:axis], missing, *grid.shape[axis + 1 :])], dim=axis)
    return grid


def crop(fields: Tensor, shape: Sequence[int], first: int = 2) -> Tensor:
    """Keep the first cells of each space axis; these begin at axis `first` of the tensor."""
    for axis, cells in enumerate(shape, start=first):
        fields = fields.narrow(axis, 0, cells) if fields.shape[axis] > cells else fields
    return fields


def check_multiple(grid: Grid, multiple: int, what: str) -> None:
    """Raise ConfigError for grids that a network which coarsens by `multiple` cannot take.

    Args:
        grid: The grid.
        multiple: Cells of the grid in one of the coarsest level.
        what: The network, for the message, e.g. "a U-Net of depth 3".

    Raises:
        ConfigError: if an axis is shorter than that, or periodic and not a multiple of it.
    """
    if min(grid.shape) < multiple:
        raise ConfigError(
            f"A grid of {grid.shape} cells is too small for {what}, which coarsens it {multiple} times: use at least "
            f"{multiple} cells along each axis, or coarsen less."
        )
    for axis, (cells, wraps) in enumerate(zip(grid.shape, grid.periodic, strict=True)):
        if wraps and cells % multiple:
            raise ConfigError(
                f"Axis {axis} is periodic, so its {cells} cells must be a multiple of {multiple} for {what}; the "
                f"nearest is {round(cells / multiple) * multiple or multiple}."
            )
