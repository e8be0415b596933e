"""Windows or the whole grid: chosen in each call by the cells that the network would compute."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.windows.axis import Axis
from nmpm.emulator.windows.cover import CALL_CELLS, Window, cover_scene
from nmpm.emulator.windows.memory import Memory, erode
from nmpm.emulator.windows.network import mark_known, mark_readable, predict_windows
from nmpm.emulator.windows.occupied import WORTHWHILE, Blocks, readable_blocks
from nmpm.emulator.windows.reads import UncoveredReadError
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import GridProcessor
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, Transfer

if TYPE_CHECKING:
    from nmpm.emulator.recipe import EmulatorRecipe

T = TypeVar("T")

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
        windows: At least one, unless the memory holds all.
        axes: Of the grid.
        readable: (B, *S) bool, the cells that particles may be in when they read the output.
        most: Cells to compute at once at most.
        memory: Has seen the state; holds the output that is known already, and takes the new one. None for none.
    """

    windows: list[Window]
    axes: tuple[Axis, ...]
    readable: Tensor
    most: int
    memory: Memory | None = None

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
        return _cover([everything] * batch, self.axes, self.most, self.readable.device, self.memory)

    def predict(self, network: GridProcessor, grid: Tensor) -> Tensor:
        """The network's output, (B, m, C_out, *S), arbitrary where it must not be read; grid (B, C_in, *S)."""
        memory = self.memory
        if memory is None:
            return predict_windows(network, grid, self.windows, self.axes, self.most)
        before, known = memory.output, memory.known
        if before is not None and before.is_inference() and not torch.is_inference_mode_enabled():
            before = before.clone()  # torch lets nobody change it
        output = predict_windows(network, grid, self.windows, self.axes, self.most, before)
        nowhere = torch.zeros(len(grid), *grid.shape[2:], dtype=torch.bool)
        memory.keep(output, mark_known(self.windows, self.axes, nowhere if known is None else known))
        return output


def find_in_windows(coverage: Coverage | None, find: Callable[[Coverage | None], T]) -> T:
    """What `find` gives with the network on windows; on the whole grid without them, or if more is read than they hold.

    Args:
        coverage: Chosen by where particles are expected.
        find: Raises UncoveredReadError if they read anything else.
    """
    if coverage is None:
        return find(None)
    try:
        return find(coverage)
    except UncoveredReadError:
        return find(coverage.whole())


def choose_windows(
    options: Windows | None,
    network: GridProcessor,
    recipe: EmulatorRecipe,
    state: Tensor,
    memory: Memory | None = None,
) -> Coverage | None:
    """The windows for a bundle; None where the whole grid is cheaper, or must be computed.

    That is: in traced graphs and compiled networks, whose shapes are fixed; where gradients are recorded; for networks
    without a radius, and transfers of other packages, whose kernels may be wider.

    Args:
        options: The limits; None for never.
        network: What is to run.
        recipe: Of the emulator that it is part of.
        state: (B, C_in, *S) in grid units.
        memory: From `usable_memory`.
    """
    grid = recipe.grid
    if options is None or not _is_possible(options, network, grid, recipe.transfer, state):
        return None
    radius = network.radius or 0
    axes = tuple(
        Axis(cells, wraps, radius, network.alignment) for cells, wraps in zip(grid.shape, grid.periodic, strict=True)
    )
    batch, most = len(state), options.most_cells or sys.maxsize
    bounded = batch * grid.size > most
    blocks = readable_blocks(state, len(recipe.scene.materials), recipe.frames, axes)
    unknown = None if memory is None else memory.see(state, axes)
    if unknown is not None:
        blocks = blocks & unknown
    elif not blocks.any():
        return None
    if blocks.all() and not bounded:
        return None
    coverage = _cover(list(blocks), axes, most, state.device, memory)
    cost = coverage.cells + CALL_CELLS * len(coverage.windows)
    return coverage if bounded or cost <= WORTHWHILE * batch * grid.size else None


def usable_memory(
    memory: Memory | None, options: Windows | None, network: GridProcessor, recipe: EmulatorRecipe, state: Tensor
) -> Memory | None:
    """The memory, if it can be used in a call; else None, and the memory is emptied.

    It is where windows can: on large grids, as on small ones each cell sees most others, in inference on the CPU.
    Arguments as of `choose_windows`.
    """
    if memory is None:
        return None
    if (
        options is not None
        and state.device.type == "cpu"
        and _is_possible(options, network, recipe.grid, recipe.transfer, state)
    ):
        return memory
    memory.forget()
    return None


def _cover(
    blocks: Sequence[Blocks], axes: tuple[Axis, ...], most: int, device: torch.device, memory: Memory | None
) -> Coverage:
    windows = [window for scene, marked in enumerate(blocks) for window in cover_scene(marked, axes, scene, most)]
    if memory is None or memory.known is None:
        readable = mark_readable(windows, axes, len(blocks), device)
    else:
        readable = erode(mark_known(windows, axes, memory.known), axes)
    return Coverage(windows, axes, readable, most, memory)


def _is_possible(options: Windows, network: GridProcessor, grid: Grid, transfer: Transfer, state: Tensor) -> bool:
    fixed = torch.compiler.is_compiling() or network._compiled_call_impl is not None
    if fixed or torch.is_grad_enabled() or grid.size < options.least_cells:
        return False
    here = state.device.type in options.device_types
    return here and isinstance(network, GridProcessor) and network.radius is not None and type(transfer) in _TRANSFERS
