"""The network's last output in a rollout, which stays where the network sees no change, as in material at rest."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.windows.axis import BLOCK, READ, Axis
from nmpm.emulator.windows.occupied import Blocks, dilate


class Memory:
    """What the network has predicted, and from what; empty at first. A rollout has one of its own.

    Attributes:
        output: (B, m, C_out, *S), arbitrary outside of `known`; None while the memory is empty.
        known: (B, *S) bool, where the output is what the network predicts from the state.
    """

    def __init__(self) -> None:
        self.output: Tensor | None = None
        self.known: Tensor | None = None
        self._state: Tensor | None = None

    def see(self, state: Tensor, axes: tuple[Axis, ...]) -> Blocks | None:
        """Take in the grid state (B, C_in, *S) of a call, and forget the output of all cells that see a change.

        Returns:
            (B, *blocks), True where particles would read output that is not known; None while the memory is empty.
        """
        before, self._state = self._state, state
        if before is None or self.known is None or before.shape != state.shape:
            self.output = self.known = None
            return None
        changed = block_any((before != state).any(1), axes)
        stale = dilate(changed, axes, [axis.radius + _seam(axis) for axis in axes])
        self.known = self.known & torch.from_numpy(~_cells(stale, axes))
        return dilate(block_any(~self.known, axes), axes, [READ + _seam(axis) for axis in axes])

    def keep(self, output: Tensor, known: Tensor | None = None) -> None:
        """Remember the output for the state last seen, known in some cells or, where they are left out, in all."""
        everywhere = torch.ones(len(output), *output.shape[3:], dtype=torch.bool)
        self.output, self.known = output, everywhere if known is None else known

    def forget(self) -> None:
        """Become empty."""
        self.output = self.known = self._state = None


def _seam(axis: Axis) -> int:
    """Cells that the last block of a periodic axis lacks, so that a distance in blocks may be too short."""
    return BLOCK if axis.periodic and axis.cells % BLOCK else 0


def block_any(cells: Tensor, axes: tuple[Axis, ...]) -> Blocks:
    """(B, *blocks), whether any cell of each block is True in (B, *S) on the CPU."""
    found = cells.numpy()
    for index, axis in enumerate(axes, start=1):
        found = np.logical_or.reduceat(found, np.arange(0, axis.cells, BLOCK), axis=index)
    return found


def erode(cells: Tensor, axes: tuple[Axis, ...]) -> Tensor:
    """(B, *S): where a cell and those beside it, along all axes, are True; beyond a wall there are none to ask."""
    for index, axis in enumerate(axes, start=1):
        below, above = cells.roll(1, index), cells.roll(-1, index)
        if not axis.periodic:
            below.select(index, 0).fill_(True)
            above.select(index, axis.cells - 1).fill_(True)
        cells = cells & below & above
    return cells


def _cells(blocks: Blocks, axes: tuple[Axis, ...]) -> Blocks:
    """(B, *S), True in the cells of marked blocks (B, *blocks)."""
    for index, axis in enumerate(axes, start=1):
        blocks = blocks.repeat(BLOCK, axis=index).take(range(axis.cells), axis=index)
    return blocks
