"""Quadratic B-spline transfers: one kernel both ways, 3 nodes per axis, continuous gradients.

Source: the kernel of most material point methods, e.g. Jiang et al., The Material Point Method for Simulating
Continuum Materials, SIGGRAPH 2016 courses, eq. 123.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer.base import Stencil, Transfer, inside, tensor_product


def quadratic_stencil(cells: Tensor, grid: Grid) -> Stencil:
    """The 3 ** D nodes around each particle, weighted by the quadratic B-spline of its distance d to the nearest."""
    offset, nearest = _nearest(cells, grid)
    d = offset - nearest
    weights = [0.5 * (0.5 - d) ** 2, 0.75 - d**2, 0.5 * (0.5 + d) ** 2]
    return tensor_product(nearest.long() - 1, weights, grid)


def _nearest(cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Places from the centre of the first node, and the nearest node to each, (B, N, D)."""
    offset = inside(cells, grid) - 0.5
    return offset, (offset.detach() + 0.5).floor()


def quadratic_places(cells: Tensor, grid: Grid) -> Tensor:
    """(B, N, 3 ** D, D) centres of the nodes of `quadratic_stencil`, in its order, in cells; not wrapped."""
    _, nearest = _nearest(cells, grid)
    steps = torch.arange(-1, 2, device=cells.device, dtype=cells.dtype)
    along = []
    for axis in range(grid.dim):
        index = nearest[..., axis, None] + steps
        index = index if grid.periodic[axis] else index.clamp(0, grid.shape[axis] - 1)
        shape = [1] * grid.dim
        shape[axis] = 3
        along.append((index + 0.5).reshape(*index.shape[:2], *shape).expand(-1, -1, *(3,) * grid.dim).flatten(2))
    return torch.stack(along, dim=-1)


@dataclass(frozen=True)
class Quadratic(Transfer):
    """Quadratic B-splines both ways: smoother than `Linear`, at 9 nodes instead of 4 (27 instead of 8 in 3-D)."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return quadratic_stencil(cells, grid)

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return quadratic_stencil(cells, grid)
