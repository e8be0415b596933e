"""Patches of cells as channels of a coarser grid, and convolutions whose stride is their kernel's width by them.

Such a convolution is one product of matrices per patch. Computed as a strided convolution in bfloat16, oneDNN 3.12
(torch 2.13) returns wrong numbers for kernels of 4 cells and more and 8 to 24 channels, on CPUs with AMX.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

_POINTWISE = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}


def embed_patches(convolution: nn.Module, grid: Tensor, patch: int) -> Tensor:
    """Apply a convolution of kernel and stride `patch`: (B, C, *S) → (B, C', *S / patch)."""
    weight, bias = convolution.get_parameter("weight"), convolution.get_parameter("bias")
    return _multiply(cells_to_channels(grid, patch), weight.flatten(1), bias)


def return_patches(transposed: nn.Module, hidden: Tensor, patch: int) -> Tensor:
    """Apply a transposed convolution of kernel and stride `patch`: (B, C, *S) → (B, C', *S * patch)."""
    weight, bias = transposed.get_parameter("weight"), transposed.get_parameter("bias")
    of_cells = bias.repeat_interleave(patch ** (hidden.dim() - 2))
    return channels_to_cells(_multiply(hidden, weight.flatten(1).t(), of_cells), patch)


def _multiply(grid: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(B, C, *S) by a (C', C) matrix at each cell."""
    dim = grid.dim() - 2
    return _POINTWISE[dim](grid, weight[(..., *(None,) * dim)], bias)


def cells_to_channels(grid: Tensor, patch: int) -> Tensor:
    """(B, C, *S) → (B, C * patch ** D, *S / patch)."""
    dim = grid.dim() - 2
    for axis in range(dim + 1, 1, -1):
        grid = grid.unflatten(axis, (-1, patch))
    within, across = range(3, 2 * dim + 2, 2), range(2, 2 * dim + 2, 2)
    coarse: Tensor = grid.permute(0, 1, *within, *across).flatten(1, dim + 1)
    return coarse


def channels_to_cells(fields: Tensor, patch: int) -> Tensor:
    """(B, C * patch ** D, *S) → (B, C, *S * patch), the inverse of `cells_to_channels`."""
    dim = fields.dim() - 2
    split = fields.unflatten(1, (-1, *(patch,) * dim))
    order = [place for axis in range(dim) for place in (2 + dim + axis, 2 + axis)]
    joined: Tensor = split.permute(0, 1, *order)
    for axis in range(2, dim + 2):
        joined = joined.flatten(axis, axis + 1)
    return joined
