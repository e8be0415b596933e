"""Windows or the whole grid: chosen in each call by the cells that the network would compute."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.windows.axis import Axis
from nmpm.emulator.windows.cover import CALL_CELLS, Window, cover_scene
from nmpm.emulator.windows.network import mark_readable, predict_windows
from nmpm.emulator.windows.occupied import WORTHWHILE, Blocks, readable_blocks
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import GridProcessor
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, Transfer

_TRANSFERS = (Nearest, Linear, Quadratic, Affine)  # exactly these interpolate from cells within `axis.READ`


@dataclass(frozen=True)
class Windows:
    """When the network runs on windows around the particles instead of the whole grid.

    Args:
        least_cells: Grids of fewer cells are computed whole.
        most_cells: Cells that the network computes at once at most, to bound its memory, unless windows would become
            narrower than three times its radius. None for no limit.
        device_types: Where: elsewhere reading back which cells are occupied would halt the device.

    Raises:
        ConfigError: if a number is not positive.
    """

    least_cells: int = 8192
    most_cells: int | None = None
    device_types: tuple[str, ...] = ("cpu",)

    def __post_init__(self) -> None:
        for name in ("least_cells", "most_cells"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"Windows.{name} = {value}: it must be at least 1.")


@dataclass(frozen=True)
class Coverage:
    """Windows that hold all that a bundle is expected to read.

    Args:
        windows: At least one.
        axes: Of the grid.
        readable: (B, *S) bool, the cells that particles may be in when they read the output.
        most: Cells to compute at once at most.
    """

    windows: list[Window]
    axes: tuple[Axis, ...]
    readable: Tensor
    most: int

    @property
    def cells(self) -> int:
        """Cells of all windows."""
        return sum(window.cells for window in self.windows)

    def whole(self) -> Coverage | None:
        """Windows that hold the whole grid; None where the network may compute that at once."""
        batch, size = len(self.readable), self.readable[0].numel()
        if batch * size <= self.most:
            return None
        everything = np.ones([axis.blocks for axis in self.axes], np.bool_)
        return _cover([everything] * batch, self.axes, self.most, self.readable.device)

    def predict(self, network: GridProcessor, grid: Tensor) -> Tensor:
        """The network's output, (B, m, C_out, *S), zero where no window holds it; grid (B, C_in, *S)."""
        return predict_windows(network, grid, self.windows, self.axes, self.most)


def choose_windows(
    options: Windows, network: GridProcessor, grid: Grid, transfer: Transfer, state: Tensor, materials: int, frames: int
) -> Coverage | None:
    """The windows for a bundle; None where the whole grid is cheaper, or must be computed.

    That is: in traced graphs and compiled networks, whose shapes are fixed; where gradients are recorded; for networks
    without a radius, and transfers of other packages, whose kernels may be wider.

    Args:
        options: The limits.
        network: What is to run.
        grid: The grid.
        transfer: What reads the output.
        state: (B, C_in, *S) in grid units.
        materials: M.
        frames: m.
    """
    if not _is_possible(options, network, grid, transfer, state):
        return None
    radius = network.radius or 0
    axes = tuple(
        Axis(cells, wraps, radius, network.alignment) for cells, wraps in zip(grid.shape, grid.periodic, strict=True)
    )
    batch, most = len(state), options.most_cells or sys.maxsize
    bounded = batch * grid.size > most
    blocks = readable_blocks(state, materials, frames, axes)
    if not blocks.any() or (blocks.all() and not bounded):
        return None
    coverage = _cover(list(blocks), axes, most, state.device)
    cost = coverage.cells + CALL_CELLS * len(coverage.windows)
    return coverage if bounded or cost <= WORTHWHILE * batch * grid.size else None


def _cover(blocks: Sequence[Blocks], axes: tuple[Axis, ...], most: int, device: torch.device) -> Coverage:
    windows = [window for scene, marked in enumerate(blocks) for window in cover_scene(marked, axes, scene, most)]
    return Coverage(windows, axes, mark_readable(windows, axes, len(blocks), device), most)


def _is_possible(options: Windows, network: GridProcessor, grid: Grid, transfer: Transfer, state: Tensor) -> bool:
    fixed = torch.compiler.is_compiling() or network._compiled_call_impl is not None
    if fixed or torch.is_grad_enabled() or grid.size < options.least_cells:
        return False
    here = state.device.type in options.device_types
    return here and isinstance(network, GridProcessor) and network.radius is not None and type(transfer) in _TRANSFERS
