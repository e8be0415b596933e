"""Fourier neural operators of `neuraloperator`, padded where the domain has walls.

Sources: Li et al., Fourier Neural Operator for Parametric Partial Differential Equations, ICLR 2021; with factorised
weights: Kossaifi et al., Multi-Grid Tensorized Fourier Neural Operator, TMLR 2024.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import GridLayout, GridProcessor, Processor, full_precision
from nmpm.processors.places import places


@dataclass(frozen=True)
class FNO(Processor):
    """Recipe of a Fourier neural operator. It takes any grid, finer and coarser ones than it was trained on too.

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
        if min(self.modes, self.width, self.layers) < 1 or not 0 <= self.padding < 1:
            raise ConfigError(f"FNO needs modes, width and layers >= 1 and 0 <= padding < 1; got {self}.")
        return FNONetwork(self, layout, {})

    def check_grid(self, grid: Grid) -> None:
        if min(grid.shape) < 2:
            raise ConfigError(f"A grid of {grid.shape} cells has no Fourier modes along an axis of one cell.")


@dataclass(frozen=True)
class TFNO(FNO):
    """Recipe of a Fourier neural operator whose weights are Tucker factors: as many modes at a part of the parameters.

    Args:
        modes: Fourier modes kept along each axis.
        width: Hidden channels.
        layers: Number of Fourier layers.
        padding: Share of each wall axis by which the grid is extended, so that it need not be periodic.
        rank: Parameters of the factors over those of the whole weights, about.
    """

    rank: float = 0.1

    def build(self, layout: GridLayout) -> GridProcessor:
        if min(self.modes, self.width, self.layers) < 1 or not 0 <= self.padding < 1 or not 0 < self.rank <= 1:
            raise ConfigError(f"TFNO needs modes, width, layers >= 1, 0 <= padding < 1 and 0 < rank <= 1; got {self}.")
        return FNONetwork(self, layout, {"factorization": "tucker", "rank": self.rank})


class FNONetwork(GridProcessor):
    """`neuralop.models.FNO` behind the contract, in float32 whatever autocast says: its transforms need it."""

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
            grid = full_precision(grid)
            placed = torch.cat([grid, places(grid, self.periodic)], dim=1)
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
