"""Convolutions in 1, 2 or 3 axes that know how each axis ends: circular padding where it wraps, zeros at walls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional

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
        self.padding = _circular_padding(periodic, pad)
        zeros = tuple(0 if wraps else pad for wraps in periodic)
        kind = CONVOLUTIONS[len(periodic)]
        self.convolution = kind(in_channels, out_channels, kernel, stride, zeros, groups=groups)

    def forward(self, grid: Tensor) -> Tensor:
        """Map (B, C, *S) to (B, C', *S / stride)."""
        if any(self.padding):
            grid = functional.pad(grid, self.padding, mode="circular")
        out: Tensor = self.convolution(grid)
        return out


class Upsampling(nn.Module):
    """A transposed convolution, kernel 4, that doubles the grid's size."""

    def __init__(self, channels: int, periodic: Sequence[bool]) -> None:
        super().__init__()
        self.padding = _circular_padding(periodic, 1)
        cropped = tuple(3 if wraps else 1 for wraps in periodic)  # twice the padding, and the kernel's overlap
        self.convolution = TRANSPOSED[len(periodic)](channels, channels, 4, 2, cropped)

    def forward(self, grid: Tensor) -> Tensor:
        """Map (B, C, *S) to (B, C, *2S)."""
        if any(self.padding):
            grid = functional.pad(grid, self.padding, mode="circular")
        out: Tensor = self.convolution(grid)
        return out


def pointwise(channels: Sequence[int], dim: int) -> nn.Sequential:
    """A perceptron applied to each cell: 1x1 convolutions of the given widths, LeakyReLU between."""
    layers: list[nn.Module] = []
    for width, following in pairwise(channels):
        layers += [CONVOLUTIONS[dim](width, following, 1), nn.LeakyReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def _circular_padding(periodic: Sequence[bool], pad: int) -> list[int]:
    return [pad if wraps else 0 for wraps in reversed(periodic) for _ in range(2)]
