"""A perceptron on each cell alone: the baseline that cannot see its neighbours."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nmpm.processors.base import GridLayout, GridProcessor, Processor
from nmpm.processors.convolution import pointwise


@dataclass(frozen=True)
class Pointwise(Processor):
    """Recipe of a pixel-wise perceptron; no hidden layer makes it linear.

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

    def forward(self, grid: Tensor) -> Tensor:
        out: Tensor = self.perceptron(grid).unflatten(1, (self.frames, -1))
        return out
