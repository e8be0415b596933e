"""A U-shaped ConvNeXt: large kernels on each channel by itself, perceptrons across channels, few memory passes.

Sources: Liu et al., A ConvNet for the 2020s, CVPR 2022; in U-shape it is the best in one-step error on 9 of 17 sets of
Ohana et al., The Well, NeurIPS 2024.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.convolution import CONVOLUTIONS, Convolution
from nmpm.processors.padding import check_multiple, crop, pad_to_multiple
from nmpm.processors.ushape import UShape, upsample_nearest, ushape_radius


@dataclass(frozen=True)
class ConvNeXt(Processor):
    """Recipe of a U-shaped ConvNeXt.

    Args:
        width: Channels of every level.
        depth: Number of down-samplings by 2.
        blocks: Blocks of each level, on the way down and on the way up.
        kernel: Width of the convolutions of single channels, odd.
        expansion: Width of the perceptrons over that of the level.
    """

    width: int = 64
    depth: int = 2
    blocks: int = 1
    kernel: int = 7
    expansion: int = 2

    def build(self, layout: GridLayout) -> GridProcessor:
        if min(self.width, self.blocks, self.expansion) < 1 or self.depth < 0 or self.kernel % 2 == 0:
            raise ConfigError(f"ConvNeXt needs width, blocks, expansion >= 1, depth >= 0, an odd kernel; got {self}.")
        return ConvNeXtNetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        check_multiple(grid, 2**self.depth, f"a ConvNeXt of depth {self.depth}")


class ConvNeXtNetwork(GridProcessor):
    """Blocks at each level; strided convolutions down, nearest cells and 1x1 convolutions up, skips added."""

    def __init__(self, recipe: ConvNeXt, layout: GridLayout) -> None:
        super().__init__()
        width, periodic, depth = recipe.width, layout.periodic, recipe.depth
        self.multiple, self.frames = 2**depth, layout.frames
        reach = recipe.blocks * (recipe.kernel // 2)
        self.alignment, self.radius = self.multiple, 1 + ushape_radius(depth, level=reach, bottom=reach, between=2)

        def level() -> nn.Sequential:
            return nn.Sequential(*(Block(recipe, periodic) for _ in range(recipe.blocks)))

        kind = CONVOLUTIONS[layout.dim]
        self.first = Convolution(layout.in_channels, width, 3, periodic)
        self.levels = UShape(
            down=[level() for _ in range(depth + 1)],
            coarsen=[Convolution(width, width, 4, periodic, stride=2) for _ in range(depth)],
            up=[level() for _ in range(depth)],
            refine=[nn.Sequential(kind(width, width, 1), upsample_nearest()) for _ in range(depth)],
        )
        self.last = kind(width, layout.frames * layout.out_channels, 1)

    def forward(self, grid: Tensor) -> Tensor:
        hidden = self.levels(self.first(pad_to_multiple(grid, self.multiple)))
        out: Tensor = crop(self.last(hidden), grid.shape[2:]).unflatten(1, (self.frames, -1))
        return out


class Block(nn.Module):
    """x + perceptron(norm(convolution of single channels)), the perceptron and norm at each cell."""

    def __init__(self, recipe: ConvNeXt, periodic: tuple[bool, ...]) -> None:
        super().__init__()
        width, wide = recipe.width, recipe.width * recipe.expansion
        kind = CONVOLUTIONS[len(periodic)]
        self.spatial = Convolution(width, width, recipe.kernel, periodic, groups=width)
        self.norm = ChannelNorm(width, len(periodic))
        self.perceptron = nn.Sequential(kind(width, wide, 1), nn.SiLU(), kind(wide, width, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        """Map (B, C, *S) to the same shape."""
        change: Tensor = self.perceptron(self.norm(self.spatial(hidden)))
        return hidden + change


class ChannelNorm(nn.Module):
    """Normalises the channels of each cell by their root mean square, so that cells do not see each other.

    Source: Zhang & Sennrich, Root Mean Square Layer Normalization, NeurIPS 2019.
    """

    def __init__(self, width: int, dim: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(width, *(1,) * dim))

    def forward(self, hidden: Tensor) -> Tensor:
        """Map (B, C, *S) to the same shape."""
        # Squares of half precision overflow; the floor keeps empty cells at zero.
        inverse = (full_precision(hidden).square().mean(dim=1, keepdim=True) + 1e-6).rsqrt()
        return hidden * inverse.to(hidden.dtype) * self.scale
