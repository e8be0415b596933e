"""Space to depth: a network on a grid `patch` times as coarse, each of whose cells holds the channels of all its fine
ones. Particles and grid still exchange at the fine resolution; the network does not pay for it.

Source of the idea: Shi et al., Real-Time Single Image and Video Super-Resolution, CVPR 2016 (its sub-pixel layer).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from torch import Tensor

from nmpm._support.plain_data import from_spec
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import cells_to_channels, channels_to_cells, check_multiple, crop, pad_to_multiple
from nmpm.processors.unet import UNet


@dataclass(frozen=True)
class Patched(Processor):
    """Recipe of a processor on patches of cells.

    Args:
        processor: The recipe of the network on the coarse grid.
        patch: Cells of a patch along each axis, at least 1.
    """

    processor: Processor = UNet(width=32, depth=2, perceptron=(32,))  # noqa: RUF009 (frozen)
    patch: int = 2

    def __post_init__(self) -> None:
        object.__setattr__(self, "processor", from_spec(self.processor, Processor))
        if self.patch < 1:
            raise ConfigError(f"Patched needs patches of at least 1 cell; got {self.patch}.")

    def build(self, layout: GridLayout) -> GridProcessor:
        cells = self.patch**layout.dim
        channels = {"in_channels": cells * layout.in_channels, "out_channels": cells * layout.out_channels}
        return PatchedNetwork(self.patch, cells, self.processor.build(dataclasses.replace(layout, **channels)))

    def check_grid(self, grid: Grid) -> None:
        check_multiple(grid, self.patch, f"patches of {self.patch} cells")
        shape = tuple(-(-cells // self.patch) for cells in grid.shape)
        spacing = tuple(self.patch * width for width in grid.spacing)
        self.processor.check_grid(dataclasses.replace(grid, shape=shape, spacing=spacing))


class PatchedNetwork(GridProcessor):
    """Patches to channels, the network on (B, C_in * patch ** D, *S / patch), channels back to patches."""

    def __init__(self, patch: int, cells: int, network: GridProcessor) -> None:
        super().__init__()
        self.patch, self.network = patch, network
        self.alignment = patch * network.alignment
        if network.radius is not None:
            self.radius = patch * network.radius + patch - 1
        if (inner := network.channel_layers) is not None:
            names = f"network.{inner.first}", f"network.{inner.last}"
            self.channel_layers = ChannelLayers(*names, cells * inner.cells)

    def forward(self, grid: Tensor) -> Tensor:
        coarse = cells_to_channels(pad_to_multiple(grid, self.patch), self.patch)
        fields = channels_to_cells(self.network(coarse).flatten(0, 1), self.patch)
        out: Tensor = fields.unflatten(0, (grid.shape[0], -1))
        return crop(out, grid.shape[2:], first=3)
