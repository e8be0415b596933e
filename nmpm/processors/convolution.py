"""Convolutions in 1, 2 or 3 axes that know how each axis ends: circular padding where it wraps, zeros at walls.

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

from torch import Tensor, nn
from torch.nn import functional

from nmpm.processors.padding import crop

CONVOLUTIONS: dict[int, Callable[..., nn.Module]] = {1: nn.Conv1d, 2: nn.Conv2d, 3: nn.Conv3d}
TRANSPOSED: dict[int, Callable[..., nn.Module]] = {1: nn.ConvTranspose1d, 2: nn.ConvTranspose2d, 3: nn.ConvTranspose3d}


class Convolution(nn.Module):
    """A convolution that keeps the grid's size, or divides it by `stride` where its kernel is 2 * stride wide.

    Args:
        in_channels: C.
        out_channels: C'.
        kernel: Cells along each axis.
        periodic: Whether each axis wraps.
        stride: Cells from one output to the next.
        groups: Channels are mixed within groups only; C for a convolution of each channel by itself.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel: int,
        periodic: Sequence[bool],
        stride: int = 1,
        groups: int = 1,
    ) -> None:
        super().__init__()
        pad = (kernel - stride + 1) // 2
        self.stride = stride
        self.padding = _circular_padding(periodic, pad)
        zeros = tuple(0 if wraps else pad for wraps in periodic)
        self.least = _least_cells(periodic, kernel if stride == 1 else 2)
        kind = CONVOLUTIONS[len(periodic)]
        self.convolution = kind(in_channels, out_channels, kernel, stride, zeros, groups=groups)

    def forward(self, grid: Tensor) -> Tensor:
        """Map (B, C, *S) to (B, C', *S / stride)."""
        shape = [cells // self.stride for cells in grid.shape[2:]]
        return crop(self.convolution(_extend(_wrap(grid, self.padding), shape, self.least, self.stride)), shape)


class Upsampling(nn.Module):
    """A transposed convolution, kernel 4, that doubles the grid's size."""

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
        """Map (B, C, *S) to (B, C, *2S)."""
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
