"""Transfers whose g2p is linear interpolation (cloud-in-cell, bilinear, trilinear), 2 nodes per axis.

Source of `Nearest`: Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753, section 3.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from nmpm.grid import Grid, per_axis
from nmpm.transfer.transfer import Stencil, Transfer, gather, inside, tensor_product


def linear_stencil(cells: Tensor, grid: Grid) -> Stencil:
    """The 2 ** D nodes around each particle, weighted by nearness: w = prod_d (1 - |x_d - c_d|)."""
    offset = inside(cells, grid) - 0.5
    base = offset.detach().floor()
    upper = offset - base
    return tensor_product(base.long(), [1 - upper, upper], grid)


def linear_g2p(field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
    """Gather a grid field (B, C, *S) at `cells` (B, N, D) with the linear kernel, (B, N, C).

    In 2-D and 3-D without periodic axes this is torch's own sampler, several times faster than the stencil on a CPU.
    """
    # The sampler's gradient is summed in no fixed order on a GPU.
    loose = cells.is_cuda and torch.are_deterministic_algorithms_enabled()
    if grid.dim == 1 or any(grid.periodic) or loose:
        return gather(linear_stencil(cells, grid), field.flatten(2).transpose(1, 2))
    unit = per_axis(operator.truediv, cells, [extent / 2 for extent in grid.shape]) - 1
    if not cells.is_cuda:
        unit = unit.nan_to_num()  # torch's CPU backward segfaults on NaN coordinates
    points = unit.reshape(unit.shape[0], *(1,) * (grid.dim - 1), *unit.shape[1:])
    last_first = field.transpose(2, -1)  # the order of axes that the sampler wants for coordinates in theirs
    sampled = functional.grid_sample(last_first, points, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.flatten(2).transpose(1, 2)


@dataclass(frozen=True)
class Linear(Transfer):
    """Linear interpolation both ways: p2g and g2p are adjoint, g2p is exact on linear fields in the interior."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return linear_stencil(cells, grid)

    def g2p(self, field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        return linear_g2p(field, cells, grid)


@dataclass(frozen=True)
class Nearest(Linear):
    """The paper's pair: p2g averages the particles in each voxel, g2p is linear interpolation.

    p2g is piecewise constant in the positions, so no gradient flows through it to them; the pair is not adjoint.
    """

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        base = inside(cells.detach(), grid).floor().long()
        return tensor_product(base, [torch.ones_like(cells, requires_grad=False)], grid)

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return linear_stencil(cells, grid)
