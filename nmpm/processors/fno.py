"""The Fourier neural operator of `neuraloperator`, padded where the domain has walls.

Source: Li et al., Fourier Neural Operator for Parametric Partial Differential Equations, ICLR 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors.base import GridLayout, GridProcessor, Processor


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
        return FNONetwork(self, layout)

    def check_grid(self, grid: Grid) -> None:
        if min(grid.shape) < 2:
            raise ConfigError(f"A grid of {grid.shape} cells has no Fourier modes along an axis of one cell.")


class FNONetwork(GridProcessor):
    """`neuralop.models.FNO` behind the contract."""

    def __init__(self, recipe: FNO, layout: GridLayout) -> None:
        super().__init__()
        from neuralop.models import FNO as Operator  # noqa: N811 (imported late: it takes seconds)

        padding = [0.0 if wraps else recipe.padding for wraps in layout.periodic]
        self.frames = layout.frames
        self.operator = Operator(
            n_modes=(recipe.modes,) * layout.dim,
            in_channels=layout.in_channels,
            out_channels=layout.frames * layout.out_channels,
            hidden_channels=recipe.width,
            n_layers=recipe.layers,
            domain_padding=padding if any(padding) else None,
        )
        self.register_state_dict_post_hook(_without_metadata)  # type: ignore[no-untyped-call]  # (torch's own)

    def forward(self, grid: Tensor) -> Tensor:
        out: Tensor = self.operator(grid).unflatten(1, (self.frames, -1))
        return out


def _without_metadata(_module: nn.Module, state: dict[str, Any], _prefix: str, _local: object) -> None:
    """Drop the record that neuraloperator adds to its state: it holds a function, which no safe format stores."""
    state.pop("_metadata", None)
