"""Baselines that every network must beat: one that changes nothing, one that sees single cells."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import pointwise


@dataclass(frozen=True)
class Identity(Processor):
    """Recipe of a processor without parameters: each frame's fields are the first input channels, the velocities.

    With the decoder `Absolute` and as many frames as one likes, everything keeps its velocity.
    """

    def build(self, layout: GridLayout) -> GridProcessor:
        return IdentityNetwork(layout)


class IdentityNetwork(GridProcessor):
    """Repeats channels; where there are fewer than are asked for, from the first on again."""

    radius = 0

    def __init__(self, layout: GridLayout) -> None:
        super().__init__()
        self.frames = layout.frames
        self.channels = [channel % layout.in_channels for channel in range(layout.out_channels)]

    def forward(self, grid: Tensor) -> Tensor:
        return grid[:, self.channels].unsqueeze(1).expand(-1, self.frames, *(-1,) * (grid.dim() - 1))


@dataclass(frozen=True)
class Pointwise(Processor):
    """Recipe of a perceptron on each cell alone, which cannot see its neighbours; no hidden layer makes it linear.

    Args:
        hidden: Widths of the hidden layers.
    """

    hidden: tuple[int, ...] = ()

    def build(self, layout: GridLayout) -> GridProcessor:
        return PointwiseNetwork(self, layout)


class PointwiseNetwork(GridProcessor):
    """1x1 convolutions."""

    radius = 0

    def __init__(self, recipe: Pointwise, layout: GridLayout) -> None:
        super().__init__()
        self.frames = layout.frames
        widths = [layout.in_channels, *recipe.hidden, layout.frames * layout.out_channels]
        self.perceptron = pointwise(widths, layout.dim)
        self.channel_layers = ChannelLayers("perceptron.0", f"perceptron.{len(self.perceptron) - 1}")

    def forward(self, grid: Tensor) -> Tensor:
        out: Tensor = self.perceptron(grid).unflatten(1, (self.frames, -1))
        return out
