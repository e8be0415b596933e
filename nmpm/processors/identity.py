"""The processor that predicts nothing new: the baseline that every network must beat, and a part for tests."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nmpm.processors.base import GridLayout, GridProcessor, Processor


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
