"""U-Nets: the paper's, and one whose levels are residual blocks or large kernels on single channels.

The paper's U-Net: pixel-wise perceptrons around convolutional levels of one width, skips concatenated.

Source: Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753, section 3 and appendix; the parameter counts are those of
its published code (875,280 at 4 input and 2 output channels, m = 8, depth 3; 1,117,200 at depth 4). That code's count
holds one convolution of twice the width that its forward pass never reaches; here it joins the coarsest level with
its skip, like its siblings above, so that each parameter works.

U-shaped networks: residual blocks, or large kernels on single channels, at levels of coarser and coarser grids.

Sources: Gupta & Brandstetter, Towards multi-spatiotemporal-scale generalized PDE modeling, TMLR 2023 (residual blocks,
GELU, channels that grow with depth); Liu et al., A ConvNet for the 2020s, CVPR 2022; both compared, the latter best in
one-step error on 9 of 17 sets: Ohana et al., The Well, NeurIPS 2024. Normalisation over groups of channels is left out
by default: it mixes all cells of a grid, so that a scene of another size, or emptier, looks different.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.convolution import (
    CONVOLUTIONS,
    Convolution,
    Upsampling,
    check_multiple,
    crop,
    pad_to_multiple,
    pointwise,
)

Modules = Iterable[nn.Module]


class UShape(nn.Module):
    """Levels of which each works on a grid half as fine as the one before; sides are multiples of the coarsest cell.

    Args:
        down: What each level does on the way down, the finest first.
        coarsen: From each level's grid to the next, one fewer.
        up: What each level but the coarsest does on the way up, the finest first.
        refine: Back from the next level's grid to each, likewise.
    """

    def __init__(self, down: Modules, coarsen: Modules, up: Modules, refine: Modules) -> None:
        super().__init__()
        self.down, self.coarsen = nn.ModuleList(down), nn.ModuleList(coarsen)
        self.up, self.refine = nn.ModuleList(up), nn.ModuleList(refine)

    def forward(self, hidden: Tensor) -> Tensor:
        hidden = self.down[0](hidden)
        skips: list[Tensor] = []
        for coarsen, level in zip(self.coarsen, list(self.down)[1:], strict=True):
            skips.append(hidden)
            hidden = level(coarsen(hidden))
        for refine, level in zip(reversed(self.refine), reversed(self.up), strict=True):
            hidden = level(skips.pop() + refine(hidden))
        return hidden


def ushape_radius(depth: int, level: int, bottom: int, between: int) -> int:
    """Radius in cells of levels of convolutions in a U shape, see `GridProcessor.radius`.

    Args:
        depth: Number of down-samplings by 2.
        level: Cells that the convolutions of a level but the coarsest reach, on the way down and on the way up each.
        bottom: Cells that those of the coarsest level reach.
        between: Cells that a step to the coarser level and back reaches; of these, the strided convolution has 1.5.
    """
    coarsest = 1 << depth
    return (coarsest - 1) * (2 * level + between) + coarsest * bottom


@dataclass(frozen=True)
class UNetModern(Processor):
    """Recipe of a residual U-Net.

    Args:
        width: Channels of the finest level.
        growth: Channels of each level over those of the finest; one less than their number are down-samplings by 2.
        blocks: Residual blocks of each level, on the way down and on the way up.
        kernel: Width of the convolutions, odd.
        groups: Groups of channels that are normalised together; 0 for no normalisation.
    """

    width: int = 32
    growth: tuple[int, ...] = (1, 2, 2, 4)
    blocks: int = 1
    kernel: int = 3
    groups: int = 0

    @property
    def depth(self) -> int:
        """Number of down-samplings."""
        return len(self.growth) - 1

    def build(self, layout: GridLayout) -> GridProcessor:
        least = min((self.width, self.blocks, *self.growth), default=0)
        if not self.growth or least < 1 or self.kernel % 2 == 0:
            raise ConfigError(f"UNetModern needs width, growth and blocks >= 1 and an odd kernel; got {self}.")
        if self.groups and any(self.width * factor % self.groups for factor in self.growth):
            raise ConfigError(f"UNetModern's groups must divide the channels of each level; got {self}.")
        return UNetModernNetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        check_multiple(grid, 2**self.depth, f"a U-Net of depth {self.depth}")


class UNetModernNetwork(GridProcessor):
    """Residual blocks at each level; strided convolutions down, nearest cells and a convolution up, skips added."""

    channel_layers = ChannelLayers("first.convolution", "last")

    def __init__(self, recipe: UNetModern, layout: GridLayout) -> None:
        super().__init__()
        periodic, kernel = layout.periodic, recipe.kernel
        widths = [recipe.width * factor for factor in recipe.growth]
        self.frames, self.alignment, reach = layout.frames, 2**recipe.depth, kernel // 2
        if not recipe.groups:  # normalisation over groups takes the mean over all cells
            wide = 2 * recipe.blocks * reach
            self.radius = reach + ushape_radius(recipe.depth, level=wide, bottom=wide, between=2 + reach)

        def level(width: int) -> nn.Sequential:
            return nn.Sequential(*(ResidualBlock(width, kernel, periodic, recipe.groups) for _ in range(recipe.blocks)))

        self.first = Convolution(layout.in_channels, widths[0], kernel, periodic)
        self.levels = UShape(
            down=map(level, widths),
            coarsen=[Convolution(fine, coarse, 4, periodic, stride=2) for fine, coarse in pairwise(widths)],
            up=map(level, widths[:-1]),
            refine=[
                nn.Sequential(nn.Upsample(scale_factor=2.0), Convolution(coarse, fine, kernel, periodic))
                for fine, coarse in pairwise(widths)
            ],
        )
        self.last = CONVOLUTIONS[layout.dim](widths[0], layout.frames * layout.out_channels, 1)

    def forward(self, grid: Tensor) -> Tensor:
        hidden = self.levels(self.first(pad_to_multiple(grid, self.alignment)))
        out: Tensor = crop(self.last(functional.silu(hidden)), grid.shape[2:]).unflatten(1, (self.frames, -1))
        return out


class ResidualBlock(nn.Module):
    """x + conv(silu(conv(silu(x)))), each convolution after a normalisation if one is asked for.

    SiLU is as smooth as the sources' GELU, at a third of its time on a CPU.
    """

    def __init__(self, width: int, kernel: int, periodic: tuple[bool, ...], groups: int) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(Convolution(width, width, kernel, periodic) for _ in range(2))
        self.norms = nn.ModuleList(nn.GroupNorm(groups, width) if groups else nn.Identity() for _ in range(2))

    def forward(self, hidden: Tensor) -> Tensor:
        change = hidden
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            change = convolution(functional.silu(norm(change)))
        return hidden + change


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

    channel_layers = ChannelLayers("first.convolution", "last")

    def __init__(self, recipe: ConvNeXt, layout: GridLayout) -> None:
        super().__init__()
        width, periodic, depth = recipe.width, layout.periodic, recipe.depth
        reach = recipe.blocks * (recipe.kernel // 2)
        self.frames, self.alignment = layout.frames, 2**depth
        self.radius = 1 + ushape_radius(depth, level=reach, bottom=reach, between=2)

        def level() -> nn.Sequential:
            return nn.Sequential(*(ConvNeXtBlock(recipe, periodic) for _ in range(recipe.blocks)))

        kind = CONVOLUTIONS[layout.dim]
        self.first = Convolution(layout.in_channels, width, 3, periodic)
        self.levels = UShape(
            down=[level() for _ in range(depth + 1)],
            coarsen=[Convolution(width, width, 4, periodic, stride=2) for _ in range(depth)],
            up=[level() for _ in range(depth)],
            refine=[nn.Sequential(kind(width, width, 1), nn.Upsample(scale_factor=2.0)) for _ in range(depth)],
        )
        self.last = kind(width, layout.frames * layout.out_channels, 1)

    def forward(self, grid: Tensor) -> Tensor:
        hidden = self.levels(self.first(pad_to_multiple(grid, self.alignment)))
        out: Tensor = crop(self.last(hidden), grid.shape[2:]).unflatten(1, (self.frames, -1))
        return out


class ConvNeXtBlock(nn.Module):
    """x + perceptron(norm(convolution of single channels)), the perceptron and norm at each cell."""

    def __init__(self, recipe: ConvNeXt, periodic: tuple[bool, ...]) -> None:
        super().__init__()
        width, wide = recipe.width, recipe.width * recipe.expansion
        kind = CONVOLUTIONS[len(periodic)]
        self.spatial = Convolution(width, width, recipe.kernel, periodic, groups=width)
        self.norm = ChannelNorm(width, len(periodic))
        self.perceptron = nn.Sequential(kind(width, wide, 1), nn.SiLU(), kind(wide, width, 1))

    def forward(self, hidden: Tensor) -> Tensor:
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
        # Squares of half precision overflow; the floor keeps empty cells at zero.
        inverse = (full_precision(hidden).square().mean(dim=1, keepdim=True) + 1e-6).rsqrt()
        return hidden * inverse.to(hidden.dtype) * self.scale


@dataclass(frozen=True)
class UNet(Processor):
    """Recipe of the paper's U-Net.

    Args:
        width: Channels of every level.
        depth: Number of down-samplings by 2.
        kernel: Width of the convolutions, odd.
        perceptron: Widths of the hidden layers of the pixel-wise encoder and decoders.
    """

    width: int = 64
    depth: int = 3
    kernel: int = 3
    perceptron: tuple[int, ...] = (64, 64, 64)

    def build(self, layout: GridLayout) -> GridProcessor:
        if self.width < 1 or self.depth < 0 or self.kernel % 2 == 0:
            raise ConfigError(f"UNet needs width >= 1, depth >= 0 and an odd kernel; got {self}.")
        return UNetNetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        check_multiple(grid, 2**self.depth, f"a U-Net of depth {self.depth}")


class UNetNetwork(GridProcessor):
    """Level by level down, then up: a convolution at each, a strided one between."""

    channel_layers = ChannelLayers("encoder.0", "decoders")

    def __init__(self, recipe: UNet, layout: GridLayout) -> None:
        super().__init__()
        width, periodic = recipe.width, layout.periodic
        self.alignment, reach = 2**recipe.depth, recipe.kernel // 2
        self.radius = ushape_radius(recipe.depth, level=reach, bottom=2 * reach, between=3)
        hidden = recipe.perceptron
        self.encoder = pointwise([layout.in_channels, *hidden, width], layout.dim)
        self.down = nn.ModuleList(Convolution(width, width, recipe.kernel, periodic) for _ in range(recipe.depth + 1))
        self.coarsen = nn.ModuleList(Convolution(width, width, 4, periodic, stride=2) for _ in range(recipe.depth))
        self.up = nn.ModuleList(Convolution(2 * width, width, recipe.kernel, periodic) for _ in range(recipe.depth + 1))
        self.refine = nn.ModuleList(Upsampling(width, periodic) for _ in range(recipe.depth))
        self.decoders = nn.ModuleList(
            pointwise([width, *hidden, layout.frames], layout.dim) for _ in range(layout.out_channels)
        )

    def forward(self, grid: Tensor) -> Tensor:
        shape = grid.shape[2:]
        hidden = self.encoder(pad_to_multiple(grid, self.alignment))
        skips = []
        for convolve, coarsen in zip(self.down, self.coarsen, strict=False):
            skips.append(_activate(convolve(hidden)))
            hidden = _activate(coarsen(skips[-1]))
        skips.append(hidden)
        hidden = _activate(self.down[-1](hidden))
        for level in range(len(self.refine), -1, -1):
            hidden = _activate(self.up[level](torch.cat([hidden, skips[level]], dim=1)))
            if level > 0:
                hidden = _activate(self.refine[level - 1](hidden))
        fields = torch.stack([decoder(hidden) for decoder in self.decoders], dim=2)
        return crop(fields, shape, first=3)


def _activate(hidden: Tensor) -> Tensor:
    return functional.leaky_relu(hidden, inplace=True)
