"""The contract of grid processors: image-to-image networks that know nothing about particles.

A processor comes in two parts. The *recipe*, a frozen dataclass of hyperparameters, is what configurations name and
checkpoints store. Its `build` makes the *network* once the scene has said how many channels and axes there are:

    forward(grid: (B, C_in, *S)) -> (B, m, C_out, *S)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor, nn

from nmpm.grid import Grid
from nmpm.scene import Scene


@dataclass(frozen=True)
class GridLayout:
    """The channels, frames and axes that scene and emulator demand of a network.

    Args:
        in_channels: C_in, channels of the grid state.
        out_channels: C_out, velocity channels for each predicted frame.
        frames: m, frames predicted by one call (time bundling).
        periodic: Whether each space axis wraps; its length is the number of axes.
        in_names, out_names: Names of the scene's channels, for networks to which directions matter; what else a network
            reads has none.
    """

    in_channels: int
    out_channels: int
    frames: int
    periodic: tuple[bool, ...]
    in_names: tuple[str, ...] = ()
    out_names: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Scene, frames: int) -> Self:
        """The layout of a scene's channels."""
        names = scene.input_channels, scene.output_channels
        return cls(len(names[0]), len(names[1]), frames, scene.periodic, *names)

    @property
    def dim(self) -> int:
        """Number of space axes."""
        return len(self.periodic)


@dataclass(frozen=True)
class ChannelLayers:
    """Names of the two layers of a network whose shapes depend on its channels.

    Args:
        first: Reads the grid state, and has a bias; the second axis of its weight has `cells` entries for each channel,
            then those of what else it reads.
        last: Writes the fields; the first axis of its weight has `cells` entries for each channel of each frame. Or a
            list of networks, `cells` for each channel, whose last layers write a field's m frames.
        cells: Entries for each channel, more than 1 in networks on patches.
    """

    first: str
    last: str
    cells: int = 1


class GridProcessor(nn.Module, ABC):
    """A network from a grid state to the next m grid velocity fields.

    Attributes:
        radius: Cells along each axis from which an output cell depends on the input; None, as here, if it may depend on
            the whole grid. With a radius, windows of a grid can be computed instead of all of it.
        alignment: Cells by whose multiples the input may be shifted so that the output is shifted alike, e.g. 2 for a
            network that works on a grid half as fine.
        channel_layers: The layers by which a trained network is given other channels; None, as here, if it cannot be.
        noise: Channels of standard normal numbers that it reads after the grid state; without them, it takes zeros.
    """

    radius: int | None = None
    alignment: int = 1
    channel_layers: ChannelLayers | None = None
    noise: int = 0

    @abstractmethod
    def forward(self, grid: Tensor) -> Tensor:
        """Map (B, C_in, *S) to (B, m, C_out, *S)."""


class Processor(ABC):
    """A processor's recipe. Subclasses are frozen dataclasses of plain hyperparameters."""

    @abstractmethod
    def build(self, layout: GridLayout) -> GridProcessor:
        """The network for a layout, of random weights; raises ConfigError if the hyperparameters cannot make one."""

    def check_grid(self, grid: Grid) -> None:  # noqa: B027 (a processor without demands need say nothing)
        """Raise ConfigError for an unsuitable grid, suggesting one that fits. Unless overridden, any grid is."""


def full_precision(grid: Tensor) -> Tensor:
    """The grid in float32, or in float64 if it is: Fourier transforms take nothing less on most devices."""
    return grid.to(torch.promote_types(grid.dtype, torch.float32))
