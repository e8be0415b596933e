"""A factorised Fourier neural operator: transforms along one axis at a time, so that weights grow with one axis only.

Source: Tran, Mathews, Xie & Ong, Factorized Fourier Neural Operators, ICLR 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.convolution import CONVOLUTIONS
from nmpm.processors.padding import crop
from nmpm.processors.places import places


@dataclass(frozen=True)
class FFNO(Processor):
    """Recipe of a factorised Fourier neural operator. It takes any grid, finer and coarser ones too.

    Args:
        modes: Fourier modes kept along each axis.
        width: Hidden channels.
        layers: Number of layers.
        expansion: Width of the perceptron in a layer over the hidden channels.
        padding: Share of each wall axis by which the grid is extended, so that it need not be periodic.
    """

    modes: int = 16
    width: int = 64
    layers: int = 4
    expansion: int = 2
    padding: float = 0.125

    def build(self, layout: GridLayout) -> GridProcessor:
        least = min(self.modes, self.width, self.layers, self.expansion)
        if least < 1 or not 0 <= self.padding < 1:
            raise ConfigError(f"FFNO needs modes, width, layers and expansion >= 1 and 0 <= padding < 1; got {self}.")
        return FFNONetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        if min(grid.shape) < 2:
            raise ConfigError(f"A grid of {grid.shape} cells has no Fourier modes along an axis of one cell.")


class FFNONetwork(GridProcessor):
    """Layers x + perceptron(sum over axes of spectral(x)), between perceptrons at each cell."""

    def __init__(self, recipe: FFNO, layout: GridLayout) -> None:
        super().__init__()
        kind = CONVOLUTIONS[layout.dim]
        self.frames, self.padding = layout.frames, recipe.padding
        self.periodic = layout.periodic
        # Where cells are tells them apart: spectral layers alone do not know walls from the middle.
        self.first = kind(layout.in_channels + layout.dim, recipe.width, 1)
        self.layers = nn.ModuleList(Layer(recipe, layout.dim) for _ in range(recipe.layers))
        self.last = nn.Sequential(
            kind(recipe.width, 2 * recipe.width, 1),
            nn.SiLU(),
            kind(2 * recipe.width, layout.frames * layout.out_channels, 1),
        )

    def forward(self, grid: Tensor) -> Tensor:
        shape = grid.shape[2:]
        hidden = self.first(torch.cat([grid, places(grid, self.periodic)], dim=1))
        extended = [0 if wraps else math.ceil(self.padding * n) for n, wraps in zip(shape, self.periodic, strict=True)]
        hidden = functional.pad(hidden, [side for extra in reversed(extended) for side in (0, extra)])
        for layer in self.layers:
            hidden = layer(hidden)
        out: Tensor = self.last(crop(hidden, shape)).unflatten(1, (self.frames, -1))
        return out


class Layer(nn.Module):
    """One layer; its transforms run in float32 whatever autocast says."""

    def __init__(self, recipe: FFNO, dim: int) -> None:
        super().__init__()
        width = recipe.width
        self.dim, self.modes = dim, recipe.modes
        # Real and imaginary parts: complex parameters are poorly supported by optimisers and file formats. Three axes,
        # as those of four and five are taken for convolutions' by torch's memory formats.
        weights = torch.randn(dim * recipe.modes, width * width, 2) * math.sqrt(1 / (2 * width))
        self.weight = nn.Parameter(weights)
        kind = CONVOLUTIONS[dim]
        wide = recipe.expansion * width
        self.perceptron = nn.Sequential(kind(width, wide, 1), nn.SiLU(), kind(wide, width, 1))

    def forward(self, hidden: Tensor) -> Tensor:
        """Map (B, C, *S) to the same shape."""
        with torch.autocast(hidden.device.type, enabled=False):
            full = full_precision(hidden)
            mixed = torch.stack([self._along(full, axis) for axis in range(self.dim)]).sum(0)
        out: Tensor = hidden + self.perceptron(mixed.to(hidden.dtype))
        return out

    def _along(self, hidden: Tensor, axis: int) -> Tensor:
        """The lowest modes along one axis, mixed across channels, each with its own matrix."""
        moved = hidden.movedim((1, axis + 2), (-1, -2))
        spectrum = torch.fft.rfft(moved, dim=-2, norm="ortho")
        kept, first = min(spectrum.shape[-2], self.modes), axis * self.modes
        width = spectrum.shape[-1]
        matrix = torch.view_as_complex(self.weight[first : first + kept].to(hidden.dtype)).unflatten(-1, (width, width))
        mixed = torch.einsum("...kc,kcd->...kd", spectrum[..., :kept, :], matrix)
        back: Tensor = torch.fft.irfft(mixed, n=moved.shape[-2], dim=-2, norm="ortho")
        return back.movedim((-1, -2), (1, axis + 2))
