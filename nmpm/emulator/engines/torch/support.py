"""Support: only particles that something holds up can be at rest; others fall, instead of hanging in the air.

Below a cell, along the axis on which gravity is largest, there must be bearing cells down to the floor or to an
obstacle, with gaps of fewer than `REACH` cells. A cell bears if it, or a cell beside it, is filled to `ENOUGH`: small
overhangs are held up, drops under a ceiling are not. Without gravity, or with gravity along a periodic axis, where
there is no floor, everything is held; along an open axis obstacles alone hold. All in cells; nothing is read back from
the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.grid import Grid
from nmpm.scene import Scene
from nmpm.transfer import linear_g2p

REACH = 2
"""Empty cells between two bearing ones that break the support; settled water in layers leaves every other row empty."""

ENOUGH = 0.1
"""Volume fraction from which a cell bears: thin layers of sand on a ramp bear, too."""

MAX_DROP = 0.5
"""Cells that a particle falls in a bundle at most: less than the distance of what lies below an unsupported cell."""


def drops(gravity: Tensor, frames: int) -> Tensor:
    """(B, m, 1, D): what a particle falls from rest until each frame of a bundle, at most `MAX_DROP` long.

    Gravity (B, 1, D) is what a frame adds to a velocity.
    """
    count = torch.arange(1, frames + 1, device=gravity.device, dtype=gravity.dtype).view(-1, 1, 1)
    longest = frames * (frames + 1) / 2 * gravity.norm(dim=-1, keepdim=True)
    largest: Tensor = gravity * (MAX_DROP / 2 / longest.clamp(min=MAX_DROP))
    return largest.unsqueeze(1) * torch.addcmul(count, count, count)


def floor_rows(scene: Scene, grid: Grid) -> tuple[tuple[int, int], ...]:
    """For each axis, how many rows of cells at its lower and at its upper end are at least half beyond the walls."""
    rows = []
    for (low, high), first, width, extent in zip(scene.bounds, grid.lower, grid.spacing, grid.shape, strict=True):
        beyond = (low - first) / width, extent - (high - first) / width
        rows.append((max(0, math.floor(beyond[0] + 0.5)), max(0, math.floor(beyond[1] + 0.5))))
    return tuple(rows)


@dataclass(frozen=True)
class Support:
    """Which cells of B scenes hold their material up.

    Args:
        filled: (B, 1, *S) volume fraction of all materials.
        obstacle: (B, 1, *S) share of each cell's room that is obstacle; None where there are no obstacles.
        scene: Gives the bounds.
        grid: The grid.
    """

    filled: Tensor
    obstacle: Tensor | None
    scene: Scene
    grid: Grid

    def holds(self, cells: Tensor, ends: Tensor, gravity: Tensor) -> Tensor:
        """(B, N) bool: whether something holds particles up that would fall from cells to ends (B, N, D).

        Below them against gravity (B, 1, D), or an obstacle on their way.
        """
        rows = cells.nan_to_num(0.0, 0.0, 0.0).floor().long()
        node = torch.zeros_like(rows[..., 0])
        for row, extent, wraps in zip(rows.unbind(-1), self.grid.shape, self.grid.periodic, strict=True):
            node = node * extent + (row.remainder(extent) if wraps else row.clamp(0, extent - 1))
        held = self.supported_cells(gravity).flatten(1).gather(1, node)
        if self.obstacle is None:
            return held
        return held | (linear_g2p(self.obstacle.to(ends.dtype), ends, self.grid).squeeze(-1) > SURFACE)

    def supported_cells(self, gravity: Tensor) -> Tensor:
        """(B, *S) bool: whether the material in a cell is held up against gravity (B, 1, D)."""
        pull = gravity.squeeze(1)
        along = pull.abs().argmax(1)  # the first of axes that are equal
        breaks = torch.zeros_like(self.filled[:, 0])
        for axis in (axis for axis, wraps in enumerate(self.grid.periodic) if not wraps):
            acts = (along == axis) & (pull[:, axis] != 0)
            broken = self._broken_along(axis, pull[:, axis] > 0)
            breaks = torch.addcmul(breaks, broken, acts.view(-1, *(1,) * self.grid.dim).to(broken.dtype))
        return breaks == 0

    def _broken_along(self, axis: int, upwards: Tensor) -> Tensor:
        """(B, *S) 1 where support along an axis ends below a cell, else 0; gravity points upwards (B,), or down.

        On the way up from the floor what happened last decides: a base, or a gap between bearing cells.
        """
        cells = self._widest(axis)
        if self.obstacle is not None:
            cells = torch.cat([cells, self.obstacle.to(cells.dtype)], dim=1)
        above = upwards.view(-1, *(1,) * (self.grid.dim + 1))
        columns = _turned(cells.movedim(axis + 2, -1), above)
        count, has_floor = columns.shape[-1], self.scene.confined[axis]
        low, high = floor_rows(self.scene, self.grid)[axis] if has_floor else (0, 0)
        order = torch.arange(count, device=columns.device, dtype=columns.dtype)
        base = order < low + (high - low) * above.squeeze(1)
        if self.obstacle is not None:
            base = base | (columns[:, 1] >= SURFACE)
        near = bears = base | (columns[:, 0] >= ENOUGH)
        for distance in range(1, REACH):
            near = near | _shift(bears, distance, fill=1)
        gap = ~near
        event = (2 * (order + 1) + gap) * (gap | base)  # odd where support ends
        last = _running_max(_shift(event, 1, fill=0 if has_floor else 1))  # beyond an open axis nothing bears
        return _turned(last.remainder(2).unsqueeze(1), above).squeeze(1).movedim(-1, axis + 1)

    def _widest(self, axis: int) -> Tensor:
        """(B, 1, *S): the largest volume fraction in a cell and those beside it, across the axis."""
        across = [int(other != axis) for other in range(self.grid.dim)]
        wraps = [side * periodic for side, periodic in zip(across, self.grid.periodic, strict=True)]
        walls = [side - wrap for side, wrap in zip(across, wraps, strict=True)]
        filled = self.filled
        if any(wraps):
            ends = [side for wrap in reversed(wraps) for side in (wrap, wrap)]
            filled = functional.pad(filled, ends, mode="circular")
        pool = (functional.max_pool1d, functional.max_pool2d, functional.max_pool3d)[self.grid.dim - 1]
        widest: Tensor = pool(filled, [2 * side + 1 for side in across], stride=1, padding=walls)
        return widest


def _turned(values: Tensor, turns: Tensor) -> Tensor:
    """Values (B, ..., n), the last axis reversed in scenes where `turns` (B, ...) is True."""
    return torch.where(turns, values.flip(-1), values)


def _shift(values: Tensor, by: int, fill: int) -> Tensor:
    """(..., n) moved `by` < n places on."""
    return functional.pad(values, (by, -by), value=fill)


def _running_max(values: Tensor) -> Tensor:
    """(B, ..., n): the largest so far of counts (B, ..., n); `torch.cummax` cannot be exported to ONNX."""
    largest, by = values.flatten(1, -2), 1
    while by < values.shape[-1]:
        padded = functional.pad(largest, (7 * by, 0), value=-1)  # zeros ONNX Runtime would fuse, and then refuse
        largest = functional.max_pool1d(padded, 8, stride=1, dilation=by)
        by *= 8
    return largest.view(values.shape)
