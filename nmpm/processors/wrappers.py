"""Networks around a network: on a coarser grid, with noise, in other axes.

Space to depth: a network on a grid `patch` times as coarse, each of whose cells holds the channels of all its fine
ones. Particles and grid still exchange at the fine resolution; the network does not pay for it.

Source of the idea: Shi et al., Real-Time Single Image and Video Super-Resolution, CVPR 2016 (its sub-pixel layer).

Networks with noise: an output for each draw, so that one state has several futures.

The noise is further channels of the input, of standard normal numbers in each cell: some stay as they are, the others
are gathered to blocks of cells, so that neighbouring cells share them. Its weights start at zero: the network then
computes what the one without noise does, whose weights it may be given.

Sources of the idea: Price et al., Probabilistic weather forecasting with machine learning, Nature 2025; Alet et al.,
Skillful joint probabilistic weather forecasting from marginals, arXiv 2506.10772; Lang et al., AIFS-CRPS, arXiv
2412.15832.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm._support.plain_data import from_spec, to_tuples
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import cells_to_channels, channels_to_cells, check_multiple, crop, pad_to_multiple
from nmpm.processors.unet import UNet
from nmpm.scene import Turn


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


@dataclass(frozen=True)
class Turned(Processor):
    """Recipe of a processor whose network works in other axes than the grid's.

    Args:
        processor: The recipe of the network.
        axes: For each axis of the network the grid's, such as ("x", "z", "-y"), see `nmpm.scene.Turn`.
    """

    processor: Processor
    axes: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "processor", from_spec(self.processor, Processor))
        object.__setattr__(self, "axes", to_tuples(self.axes))
        if isinstance(self.processor, Turned):
            raise ConfigError("Turned is given a processor that is turned already.")
        Turn(self.axes)

    def build(self, layout: GridLayout) -> GridProcessor:
        if not layout.in_names or len(self.axes) != layout.dim:
            raise ConfigError(f"Turned needs the names of the channels of {len(self.axes)} axes; got {layout}.")
        within = dataclasses.replace(layout, periodic=Turn(self.axes).permuted(layout.periodic))
        return TurnedNetwork(Turn(self.axes), self.processor.build(within), layout)

    def check_grid(self, grid: Grid) -> None:
        turn = Turn(self.axes)
        turned = {name: turn.permuted(getattr(grid, name)) for name in ("shape", "lower", "spacing", "periodic")}
        self.processor.check_grid(Grid(**turned))


class TurnedNetwork(GridProcessor):
    """The grid state in the network's axes, the network, and its fields in the grid's axes."""

    def __init__(self, turn: Turn, network: GridProcessor, layout: GridLayout) -> None:
        super().__init__()
        self.network, self.alignment, self.noise = network, network.alignment, network.noise
        if not any(turn.mirrored):  # a crop of a mirrored grid begins elsewhere in the network's blocks
            self.radius = network.radius
        if (layers := network.channel_layers) is not None:
            self.channel_layers = ChannelLayers(f"network.{layers.first}", f"network.{layers.last}", layers.cells)
        self._there, self._back = turn, turn.inverse
        self._inputs, self._outputs = turn.channels(layout.in_names), turn.inverse.channels(layout.out_names)

    def forward(self, grid: Tensor) -> Tensor:
        out: Tensor = self.network(_turned(grid, self._there, self._inputs))
        turned: Tensor = _turned(out.flatten(0, 1), self._back, self._outputs).unflatten(0, out.shape[:2])
        return turned


def _turned(grid: Tensor, turn: Turn, channels: Sequence[tuple[int, bool]]) -> Tensor:
    """Channels (B, C, *S), the components of vectors named by `channels`, along the axes that a turn makes."""
    taken = [-grid[:, source] if mirror else grid[:, source] for source, mirror in channels]
    turned = torch.cat([torch.stack(taken, dim=1), grid[:, len(channels) :]], dim=1)
    turned = turned.permute(0, 1, *(2 + source for source in turn.sources))
    flipped = [2 + axis for axis, mirror in enumerate(turn.mirrored) if mirror]
    layout = torch.channels_last if turned.dim() == 4 else torch.contiguous_format
    return turned.flip(flipped).contiguous(memory_format=layout)
