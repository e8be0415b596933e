"""Fourier neural operators, padded where the domain has walls: FNO and TFNO by `neuraloperator`, and a factorised one.

Sources: Li et al., Fourier Neural Operator for Parametric Partial Differential Equations, ICLR 2021; with Tucker
factors: Kossaifi et al., Multi-Grid Tensorized Fourier Neural Operator, TMLR 2024; along one axis at a time: Tran,
Mathews, Xie & Ong, Factorized Fourier Neural Operators, ICLR 2023.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import ChannelLayers, GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.convolution import CONVOLUTIONS, crop


class _Fourier(Processor):
    """Operators that take any grid, finer and coarser ones than they were trained on too."""

    def check_grid(self, grid: Grid) -> None:
        if min(grid.shape) < 2:
            raise ConfigError(f"A grid of {grid.shape} cells has no Fourier modes along an axis of one cell.")


@dataclass(frozen=True)
class FNO(_Fourier):
    """Recipe of a Fourier neural operator.

    Args:
        modes: Fourier modes kept along each axis.
        width: Hidden channels.
        layers: Number of Fourier layers.
        padding: Share of each wall axis by which the grid is extended, so that it need not be periodic.
    """

    modes: int = 16
    width: int = 64
    layers: int = 4
    padding: float = 0.125

    def build(self, layout: GridLayout) -> GridProcessor:
        return self._network(layout)

    def _network(self, layout: GridLayout, **weights: Any) -> GridProcessor:
        if min(self.modes, self.width, self.layers) < 1 or not 0 <= self.padding < 1:
            name = type(self).__name__
            raise ConfigError(f"{name} needs modes, width and layers >= 1 and 0 <= padding < 1; got {self}.")
        return FNONetwork(self, layout, weights)


@dataclass(frozen=True)
class TFNO(FNO):
    """Recipe of an `FNO` whose weights are Tucker factors: as many modes at a part of the parameters.

    Args:
        rank: Parameters of the factors over those of the whole weights, about; the others as of `FNO`.
    """

    rank: float = 0.1

    def build(self, layout: GridLayout) -> GridProcessor:
        if not 0 < self.rank <= 1:
            raise ConfigError(f"TFNO needs 0 < rank <= 1; got {self}.")
        return self._network(layout, factorization="tucker", rank=self.rank)


class FNONetwork(GridProcessor):
    """`neuralop.models.FNO` behind the contract, in float32 whatever autocast says: its transforms need it."""

    channel_layers = ChannelLayers("operator.lifting.fcs.0", "operator.projection.fcs.1")

    def __init__(self, recipe: FNO, layout: GridLayout, weights: dict[str, Any]) -> None:
        super().__init__()
        from neuralop.models import FNO as Operator  # noqa: N811 (imported late: it takes seconds)

        padding = [0.0 if wraps else recipe.padding for wraps in layout.periodic]
        self.frames, self.periodic = layout.frames, layout.periodic
        self.operator = Operator(
            n_modes=(recipe.modes,) * layout.dim,
            in_channels=layout.in_channels + layout.dim,
            out_channels=layout.frames * layout.out_channels,
            hidden_channels=recipe.width,
            n_layers=recipe.layers,
            positional_embedding=None,  # its own would tell cells apart along periodic axes as well
            domain_padding=padding if any(padding) else None,
            **weights,
        )
        self.register_state_dict_post_hook(_without_metadata)  # type: ignore[no-untyped-call]  # (torch's own)

    def forward(self, grid: Tensor) -> Tensor:
        with torch.autocast(grid.device.type, enabled=False):
            placed = append_places(full_precision(grid), self.periodic)
            out: Tensor = self.operator(placed).unflatten(1, (self.frames, -1))
        return out

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """As torch's, with complex weights in the precision of the others: `double()` would leave them as they are."""

        def convert(values: Tensor) -> Tensor:
            converted = fn(values)
            if not converted.is_complex():
                return converted
            precision = torch.promote_types(fn(values.real.new_empty(0)).dtype, torch.float32)
            return converted.to(precision.to_complex())

        super()._apply(convert, recurse)  # type: ignore[no-untyped-call]  # (torch's own)
        return self


def _without_metadata(_module: nn.Module, state: dict[str, Any], _prefix: str, _local: object) -> None:
    """Drop the record that neuraloperator adds to its state: it holds a function, which no safe format stores."""
    state.pop("_metadata", None)


@dataclass(frozen=True)
class FFNO(_Fourier):
    """Recipe of a factorised Fourier neural operator, whose weights grow with one axis only.

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


class FFNONetwork(GridProcessor):
    """Layers x + perceptron(sum over axes of spectral(x)), between perceptrons at each cell."""

    channel_layers = ChannelLayers("first", "last.2")

    def __init__(self, recipe: FFNO, layout: GridLayout) -> None:
        super().__init__()
        kind = CONVOLUTIONS[layout.dim]
        self.frames, self.padding = layout.frames, recipe.padding
        self.periodic = layout.periodic
        self.first = kind(layout.in_channels + layout.dim, recipe.width, 1)
        self.layers = nn.ModuleList(SpectralLayer(recipe, layout.dim) for _ in range(recipe.layers))
        wide, outputs = 2 * recipe.width, layout.frames * layout.out_channels
        self.last = nn.Sequential(kind(recipe.width, wide, 1), nn.SiLU(), kind(wide, outputs, 1))

    def forward(self, grid: Tensor) -> Tensor:
        shape = grid.shape[2:]
        hidden = self.first(append_places(grid, self.periodic))
        extended = [0 if wraps else math.ceil(self.padding * n) for n, wraps in zip(shape, self.periodic, strict=True)]
        hidden = functional.pad(hidden, [side for extra in reversed(extended) for side in (0, extra)])
        for layer in self.layers:
            hidden = layer(hidden)
        out: Tensor = self.last(crop(hidden, shape)).unflatten(1, (self.frames, -1))
        return out


class SpectralLayer(nn.Module):
    """One layer of the factorised operator; its transforms run in float32 whatever autocast says."""

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


def append_places(grid: Tensor, periodic: tuple[bool, ...]) -> Tensor:
    """Append D channels to (B, C, *S): where each cell is between the walls of each axis, from -1 to 1.

    Zero along periodic axes. Without them, spectral layers could not tell walls from the middle.
    """
    channels = []
    for axis, wraps in enumerate(periodic, start=2):
        cells = grid.shape[axis]
        place = (2 * torch.arange(cells, device=grid.device, dtype=grid.dtype) + 1) / cells - 1
        shape = [cells if other == axis else 1 for other in range(2, grid.dim())]
        channels.append((torch.zeros_like(place) if wraps else place).reshape(shape).expand(grid.shape[2:]))
    places = torch.stack(channels).expand(grid.shape[0], *(-1,) * (grid.dim() - 1))
    return torch.cat([grid, places], dim=1)
