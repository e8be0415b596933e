"""A network on windows: gather windows → network on batches of equal windows → scatter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor

from nmpm.emulator.windows.axis import READ, Axis
from nmpm.emulator.windows.cover import Window
from nmpm.processors import GridProcessor

Region = tuple[Any, ...]  # of slices


def predict_windows(
    network: GridProcessor,
    grid: Tensor,
    windows: Sequence[Window],
    axes: Sequence[Axis],
    most: int,
    output: Tensor | None = None,
) -> Tensor:
    """The network's output (B, m, C_out, *S) where windows hold it, elsewhere zero or as in an earlier output.

    Args:
        network: With a radius.
        grid: (B, C_in, *S).
        windows: Parts of it, at least one without an earlier output.
        axes: Of the grid.
        most: Cells that the network computes at once at most; a window may have more.
        output: The earlier one, which is changed.
    """
    for batch in _batches(windows, most):
        inputs = torch.cat([_gather(grid, window, axes) for window in batch])
        if grid.dim() == 4:  # the memory layout of the whole grid's network, see `Emulator`
            inputs = inputs.contiguous(memory_format=torch.channels_last)
        fields = network(inputs)
        if output is None:
            # One row of values for each node, as the kernels of `nmpm.emulator.fused` read them.
            rows = fields.new_zeros(len(grid), *grid.shape[2:], *fields.shape[1:3])
            output = rows.movedim((-2, -1), (1, 2))
        for window, field in zip(batch, fields, strict=True):
            for there, here in _regions(window, axes, axes[0].radius):
                output[window.scene][(..., *there)] = field[(..., *here)]
    if output is None:
        raise ValueError("There are no windows to compute.")
    return output


def mark_readable(windows: Sequence[Window], axes: Sequence[Axis], batch: int, device: torch.device) -> Tensor:
    """(B, *S) bool, from which cells particles may read the output of `predict_windows`."""
    return _mark(
        windows, axes, torch.zeros(batch, *(axis.cells for axis in axes), dtype=torch.bool, device=device), READ
    )


def mark_known(windows: Sequence[Window], axes: Sequence[Axis], known: Tensor) -> Tensor:
    """(B, *S) bool, in which cells the output of `predict_windows` is right if the earlier one was so where `known`."""
    return _mark(windows, axes, known.clone(), 0)


def _mark(windows: Sequence[Window], axes: Sequence[Axis], cells: Tensor, margin: int) -> Tensor:
    """Mark what is so many cells within the right output of a window."""
    for window in windows:
        for there, _ in _regions(window, axes, axes[0].radius + margin):
            cells[window.scene][there] = True
    return cells


def _batches(windows: Sequence[Window], most: int) -> Iterator[list[Window]]:
    """Windows of equal shape together, of at most so many cells in all."""
    for shape in dict.fromkeys(window.shape for window in windows):
        equal = [window for window in windows if window.shape == shape]
        count = max(1, most // equal[0].cells)
        yield from (equal[first : first + count] for first in range(0, len(equal), count))


def _gather(grid: Tensor, window: Window, axes: Sequence[Axis]) -> Tensor:
    """(1, C, *shape)."""
    part = grid[window.scene : window.scene + 1]
    for index, (axis, start, length) in enumerate(zip(axes, window.start, window.shape, strict=True), start=2):
        pieces = [part.narrow(index, there.start, there.stop - there.start) for there, _ in axis.pieces(start, length)]
        part = torch.cat(pieces, dim=index) if len(pieces) > 1 else pieces[0]
    return part


def _regions(window: Window, axes: Sequence[Axis], margin: int) -> Iterator[tuple[Region, Region]]:
    """What is at least `margin` cells from a window's ends that are not walls: in the grid, and in the window."""
    sides = []
    for axis, start, length in zip(axes, window.start, window.shape, strict=True):
        first, count = axis.inner(start, length, margin)
        skipped = first - start
        sides.append([(there, slice(skipped + at.start, skipped + at.stop)) for there, at in axis.pieces(first, count)])
    for pairs in product(*sides):
        yield tuple(there for there, _ in pairs), tuple(here for _, here in pairs)
