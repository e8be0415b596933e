"""Convolutions in 1, 2 or 3 axes that know how each axis ends (circular padding where it wraps, zeros at walls), and
what else networks on grids share: padding to multiples, cropping, patches of cells as channels.

Axes of one cell are extended by a cell of zeros, which changes no result: oneDNN 3.12 (torch 2.13), on CPUs that
multiply matrices of bfloat16 (AMX), leaves strided convolutions to one cell along the last axis uncomputed
(https://github.com/pytorch/pytorch/issues/169688), in two dimensions as in three, and computes some 3-D convolutions
of grids with one cell along the first axis wrongly. With AVX-512 alone, it returns wrong gradients of 3-D weights in
bfloat16, and overwrites memory, where the first axis is shorter than the kernel or the second than half of it: these
axes are extended to that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid

CONVOLUTIONS: dict[int, Callable[..., nn.Module]] = {1: nn.Conv1d, 2: nn.Conv2d, 3: nn.Conv3d}
TRANSPOSED: dict[int, Callable[..., nn.Module]] = {1: nn.ConvTranspose1d, 2: nn.ConvTranspose2d, 3: nn.ConvTranspose3d}
_POINTWISE = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}


class Convolution(nn.Module):
    """A convolution that keeps the grid's size, or divides it by `stride` where its kernel is 2 * stride wide.

    Maps (B, C, *S) to (B, C', *S / stride); channels are mixed within `groups` only.
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel: int, periodic: Sequence[bool], stride: int = 1,
        groups: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        pad = (kernel - stride + 1) // 2
        self.stride = stride
        self.padding = _circular_padding(periodic, pad)
        zeros = tuple(0 if wraps else pad for wraps in periodic)
        self.least = _least_cells(periodic, kernel if stride == 1 else 2)
        kind = CONVOLUTIONS[len(periodic)]
        self.convolution = kind(in_channels, out_channels, kernel, stride, zeros, groups=groups)

    def forward(self, grid: Tensor) -> Tensor:
        shape = [cells // self.stride for cells in grid.shape[2:]]
        return crop(self.convolution(_extend(_wrap(grid, self.padding), shape, self.least, self.stride)), shape)


class Upsampling(nn.Module):
    """A transposed convolution, kernel 4, that doubles the grid's size: (B, C, *S) → (B, C, *2S)."""

    def __init__(self, channels: int, periodic: Sequence[bool]) -> None:
        super().__init__()
        self.padding = _circular_padding(periodic, 1)
        self.least = _least_cells(periodic, 2)
        # Twice the padding, and the kernel's overlap. The first of three axes is cut afterwards: where oneDNN 3.12
        # crops it by 3, the weights' gradients of short grids are wrong, in float32 too.
        self.cut = 2 if len(periodic) == 3 and periodic[0] else 0
        cropped = [3 if wraps else 1 for wraps in periodic]
        cropped[0] -= self.cut
        self.convolution = TRANSPOSED[len(periodic)](channels, channels, 4, 2, tuple(cropped))

    def forward(self, grid: Tensor) -> Tensor:
        shape = [2 * cells for cells in grid.shape[2:]]
        grid = _wrap(grid, self.padding)
        fine = self.convolution(_extend(grid, grid.shape[2:], self.least, 1))
        return crop(fine[:, :, self.cut :], shape)


def pointwise(channels: Sequence[int], dim: int) -> nn.Sequential:
    """A perceptron applied to each cell: 1x1 convolutions of the given widths, LeakyReLU between."""
    layers: list[nn.Module] = []
    for width, following in pairwise(channels):
        layers += [CONVOLUTIONS[dim](width, following, 1), nn.LeakyReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def _wrap(grid: Tensor, padding: Sequence[int]) -> Tensor:
    return functional.pad(grid, padding, mode="circular") if any(padding) else grid


def _least_cells(periodic: Sequence[bool], kernel: int) -> list[int]:
    """The shortest result that oneDNN computes correctly, in cells along each axis."""
    if len(periodic) < 3:
        return [2] * len(periodic)
    return [2 if periodic[0] else max(2, kernel), max(2, kernel // 2), 2]


def _extend(grid: Tensor, shape: Sequence[int], least: Sequence[int], stride: int) -> Tensor:
    """Add zeros at the upper end of axes that are shorter in `shape`, the result's, than `least`."""
    short = [stride * max(0, fewest - cells) for fewest, cells in zip(least, shape, strict=True)]
    missing = [end for cells in reversed(short) for end in (0, cells)]
    return functional.pad(grid, missing) if any(missing) else grid


def _circular_padding(periodic: Sequence[bool], pad: int) -> list[int]:
    return [pad if wraps else 0 for wraps in reversed(periodic) for _ in range(2)]


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
    """Raise ConfigError for axes shorter than `multiple` cells, or periodic and no multiple of it.

    `what` is the network that coarsens the grid so, for the message, e.g. "a U-Net of depth 3".
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


def embed_patches(convolution: nn.Module, grid: Tensor, patch: int) -> Tensor:
    """Apply a convolution of kernel and stride `patch`, as a product of matrices: (B, C, *S) → (B, C', *S / patch).

    As a strided convolution in bfloat16, oneDNN 3.12 (torch 2.13) returns wrong numbers for kernels of 4 cells and more
    and 8 to 24 channels, on CPUs with AMX.
    """
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
