"""Positions of cells as channels: spectral layers alone cannot tell walls from the middle."""

from __future__ import annotations

import torch
from torch import Tensor


def places(grid: Tensor, periodic: tuple[bool, ...]) -> Tensor:
    """(B, D, *S) where each cell is between the walls of each axis, from -1 to 1; zero along periodic axes."""
    channels = []
    for axis, wraps in enumerate(periodic, start=2):
        cells = grid.shape[axis]
        place = (2 * torch.arange(cells, device=grid.device, dtype=grid.dtype) + 1) / cells - 1
        shape = [cells if other == axis else 1 for other in range(2, grid.dim())]
        channels.append((torch.zeros_like(place) if wraps else place).reshape(shape).expand(grid.shape[2:]))
    return torch.stack(channels).expand(grid.shape[0], *(-1,) * (grid.dim() - 1))
