"""A trained network in other axes, as when its gravity points along -y and that of the data along -z."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm._support.plain_data import from_spec, to_tuples
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.scene import Turn


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
