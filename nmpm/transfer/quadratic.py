"""Quadratic B-spline transfers: one kernel both ways, 3 nodes per axis, continuous gradients.

Source: the kernel of most material point methods, e.g. Jiang et al., The Material Point Method for Simulating
Continuum Materials, SIGGRAPH 2016 courses, eq. 123.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer.base import Stencil, Transfer, inside, tensor_product


def quadratic_stencil(cells: Tensor, grid: Grid) -> Stencil:
    """The 3 ** D nodes around each particle, weighted by the quadratic B-spline of its distance d to the nearest."""
    offset = inside(cells, grid) - 0.5
    nearest = (offset.detach() + 0.5).floor()
    d = offset - nearest
    weights = [0.5 * (0.5 - d) ** 2, 0.75 - d**2, 0.5 * (0.5 + d) ** 2]
    return tensor_product(nearest.long() - 1, weights, grid)


@dataclass(frozen=True)
class Quadratic(Transfer):
    """Quadratic B-splines both ways: smoother than `Linear`, at 9 nodes instead of 4 (27 instead of 8 in 3-D)."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return quadratic_stencil(cells, grid)

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return quadratic_stencil(cells, grid)
