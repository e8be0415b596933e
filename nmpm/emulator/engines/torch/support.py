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

from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.grid import Grid
from nmpm.scene import Scene
from nmpm.transfer.execution import is_eager_cpu
from nmpm.transfer.linear import linear_g2p

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
    fallen: Tensor = (gravity * (MAX_DROP / longest.clamp(min=MAX_DROP))).unsqueeze(1) * (count * (count + 1) / 2)
    return fallen


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

    def holds(self, cells: Tensor, gravity: Tensor) -> Tensor:
        """(B, N) bool: whether the cells of particles (B, N, D) are supported against gravity (B, 1, D)."""
        node = torch.zeros_like(cells[..., 0], dtype=torch.long)
        for column, extent, wraps in zip(cells.unbind(-1), self.grid.shape, self.grid.periodic, strict=True):
            row = column.nan_to_num(0.0, 0.0, 0.0).floor().long()
            node = node * extent + (row.remainder(extent) if wraps else row.clamp(0, extent - 1))
        return self.supported_cells(gravity).flatten(1).gather(1, node)

    def fall(self, cells: Tensor, gravity: Tensor, frames: int) -> Tensor:
        """(B, m, N, D) positions of particles that fall from rest at (B, N, D); those that an obstacle stops stay."""
        start = cells.unsqueeze(1)
        fallen = start + drops(gravity, frames)
        if self.obstacle is None:
            return fallen
        stopped = linear_g2p(self.obstacle.to(cells.dtype), fallen[:, -1], self.grid) > SURFACE
        return torch.where(stopped.unsqueeze(1), start, fallen)

    def supported_cells(self, gravity: Tensor) -> Tensor:
        """(B, *S) bool: whether the material in a cell is held up against gravity (B, 1, D)."""
        result = torch.ones_like(self.filled[:, 0], dtype=torch.bool)
        size = gravity.squeeze(1).abs()
        taken = (size == 0).all(1)
        for axis in range(self.grid.dim):
            largest = (size[:, axis] == size.amax(1)) & ~taken  # the first of axes that are equal
            taken = taken | largest
            if self.grid.periodic[axis]:
                continue
            for upwards in (False, True):
                pull = gravity[:, 0, axis]
                pulled = largest & (pull > 0 if upwards else pull <= 0)
                if is_eager_cpu(pulled) and not bool(pulled.any()):
                    continue
                here = pulled.view(-1, *(1,) * self.grid.dim)
                result = result & (self._supported_along(axis, upwards) | ~here)  # ONNX Runtime's Where takes no bool
        return result

    def _supported_along(self, axis: int, upwards: bool) -> Tensor:
        """(B, *S) bool, where gravity points to the lower end of an axis, or upwards."""
        bears = _from_floor(self._bearing(axis), axis, upwards)
        has_floor = self.scene.confined[axis]
        rows = floor_rows(self.scene, self.grid)[axis][upwards] if has_floor else 0
        base = torch.arange(bears.shape[-1], device=bears.device) < rows
        if self.obstacle is not None:
            base = base | _from_floor(self.obstacle[:, 0] >= SURFACE, axis, upwards)
        bears = near = bears | base
        for distance in range(1, REACH):
            near = near | _shift(bears, distance, fill=1)
        gaps = (~near).int().cumsum(-1)  # in and below each cell; their number never falls on the way up
        bottom = 0 if has_floor else -1  # beyond the lower end of an open axis nothing bears
        last = torch.where(base, gaps, bottom)
        if self.obstacle is not None:
            last = _running_max(last, bottom)  # the number in the highest floor or obstacle cell so far
        held = _shift(gaps, 1, fill=0) == _shift(last, 1, fill=bottom)
        return (held.flip(-1) if upwards else held).movedim(-1, axis + 1)

    def _bearing(self, axis: int) -> Tensor:
        """(B, *S) bool: whether a cell or one beside it, across the axis, is filled enough."""
        bears = self.filled[:, 0] >= ENOUGH
        for other, wraps in enumerate(self.grid.periodic):
            if other == axis:
                continue
            row = bears.movedim(other + 1, -1)
            if wraps:
                sides = row.roll(1, -1) | row.roll(-1, -1)
            else:
                sides = _shift(row, 1, fill=0) | _shift(row.flip(-1), 1, fill=0).flip(-1)
            bears = (row | sides).movedim(-1, other + 1)
        return bears


def _from_floor(values: Tensor, axis: int, upwards: bool) -> Tensor:
    """(B, *S) with the cells along an axis last, from the floor up; gravity points to the axis' upper end or not."""
    columns = values.movedim(axis + 1, -1)
    return columns.flip(-1) if upwards else columns


def _shift(values: Tensor, by: int, fill: int) -> Tensor:
    """(..., n) moved `by` < n places on."""
    return torch.cat([torch.full_like(values[..., :by], fill), values[..., :-by]], dim=-1)


def _running_max(values: Tensor, least: int) -> Tensor:
    """(..., n): the largest so far of counts (..., n) from `least` on; `torch.cummax` cannot be exported to ONNX."""
    by = 1
    while by < values.shape[-1]:
        values = torch.maximum(values, _shift(values, by, fill=least))
        by *= 2
    return values
