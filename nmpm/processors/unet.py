"""The paper's U-Net: pixel-wise perceptrons around convolutional levels of one width, skips concatenated.

Source: Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753, section 3 and appendix; the parameter counts are those of
its published code (875,280 at 4 input and 2 output channels, m = 8, depth 3; 1,117,200 at depth 4). That code's count
holds one convolution of twice the width that its forward pass never reaches; here it joins the coarsest level with
its skip, like its siblings above, so that each parameter works.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import Convolution, Upsampling, check_multiple, crop, pad_to_multiple, pointwise
from nmpm.processors.ushape import ushape_radius


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
