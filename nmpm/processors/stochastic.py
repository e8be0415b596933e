"""Networks with noise: an output for each draw, so that one state has several futures.

The noise is further channels of the input, of standard normal numbers in each cell: some stay as they are, the others
are gathered to blocks of cells, so that neighbouring cells share them. Its weights start at zero: the network then
computes what the one without noise does, whose weights it may be given.

Sources of the idea: Price et al., Probabilistic weather forecasting with machine learning, Nature 2025; Alet et al.,
Skillful joint probabilistic weather forecasting from marginals, arXiv 2506.10772; Lang et al., AIFS-CRPS, arXiv
2412.15832.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm._support.plain_data import from_spec
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import crop, pad_to_multiple
from nmpm.processors.unet import UNet

_POOLS = {1: functional.avg_pool1d, 2: functional.avg_pool2d, 3: functional.avg_pool3d}


@dataclass(frozen=True)
class Stochastic(Processor):
    """Recipe of a processor that also reads noise.

    Args:
        processor: The recipe of the network.
        fine: Channels of noise that differs from cell to cell.
        coarse: Channels of noise that is the same within blocks of cells.
        block: Cells of a block along each axis.
    """

    processor: Processor = UNet()  # noqa: RUF009 (frozen)
    fine: int = 2
    coarse: int = 2
    block: int = 8

    def __post_init__(self) -> None:
        object.__setattr__(self, "processor", from_spec(self.processor, Processor))
        if min(self.fine, self.coarse) < 0 or self.fine + self.coarse < 1 or self.block < 1:
            raise ConfigError(f"Stochastic needs channels of noise, and blocks of at least 1 cell; got {self}.")
        if isinstance(self.processor, Stochastic):
            raise ConfigError("Stochastic is given a processor that already reads noise.")

    def build(self, layout: GridLayout) -> GridProcessor:
        channels = layout.in_channels + self.fine + self.coarse
        network = self.processor.build(dataclasses.replace(layout, in_channels=channels))
        return StochasticNetwork(self, network, layout.in_channels)

    def check_grid(self, grid: Grid) -> None:
        self.processor.check_grid(grid)


class StochasticNetwork(GridProcessor):
    """The network on (B, C_in + fine + coarse, *S); the noise after the grid state comes as it was drawn."""

    def __init__(self, recipe: Stochastic, network: GridProcessor, channels: int) -> None:
        super().__init__()
        self.network, self.alignment = network, network.alignment
        self.channels, self.noise = channels, recipe.fine + recipe.coarse
        self.coarse, self.block = recipe.coarse, recipe.block
        if (layers := network.channel_layers) is not None:
            self.channel_layers = ChannelLayers(f"network.{layers.first}", f"network.{layers.last}", layers.cells)
            weight = network.get_parameter(f"{layers.first}.weight")
            with torch.no_grad():
                weight[:, channels * layers.cells : (channels + self.noise) * layers.cells] = 0.0

    def forward(self, grid: Tensor) -> Tensor:
        if grid.shape[1] == self.channels:
            grid = torch.cat([grid, grid.new_zeros(grid.shape[0], self.noise, *grid.shape[2:])], dim=1)
        state, coarse = grid.tensor_split([grid.shape[1] - self.coarse], dim=1)
        out: Tensor = self.network(torch.cat([state, self._gathered(coarse)], dim=1) if self.coarse else state)
        return out

    def _gathered(self, noise: Tensor) -> Tensor:
        """Noise (B, C, *S) that is the same within blocks, of the same variance."""
        dim = noise.dim() - 2
        means = _POOLS[dim](pad_to_multiple(noise, self.block), self.block)
        blocks: Tensor = functional.interpolate(means * self.block ** (dim / 2), scale_factor=float(self.block))
        return crop(blocks, noise.shape[2:])
