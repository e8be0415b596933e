"""Whether a path has read only what windows hold."""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer.chunks import chunks

_FAR = 1e9  # cells; positions beyond, and those that are not finite, count as 0


class UncoveredReadError(Exception):
    """A particle has read the network's output where no window holds it. Never leaves the emulator."""


def check_reads(start: Tensor, path: Tensor, mask: Tensor, readable: Tensor, grid: Grid) -> None:
    """Raise if a path was interpolated from cells that must not be read; the value is read back from the device.

    Args:
        start: (B, N, D) positions in cells.
        path: (B, m, N, D) that followed; each frame was interpolated at the one before it, so that the last one does
            not count.
        mask: (B, N), False for padding, which does not count.
        readable: (B, *S) bool.
        grid: The grid.

    Raises:
        UncoveredReadError: naming nothing, as the caller only needs to compute the whole grid.
    """
    flat, batch = readable.flatten(1), len(readable)
    for chunk in chunks(start.shape[1], start.device, values=path.shape[1]):
        places = torch.cat([start[:, None, chunk], path[:, :-1, chunk]], dim=1)
        node = torch.zeros(places.shape[:-1], dtype=torch.int64, device=places.device)
        for column, cells, wraps in zip(places.unbind(-1), grid.shape, grid.periodic, strict=True):
            index = torch.where(column.abs() < _FAR, column, 0.0).floor().long()
            node = node * cells + (index.remainder(cells) if wraps else index.clamp(0, cells - 1))
        known = flat.gather(1, node.reshape(batch, -1)).view_as(node) | ~mask[:, None, chunk]
        if not bool(known.all()):
            raise UncoveredReadError
