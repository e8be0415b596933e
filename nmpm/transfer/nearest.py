"""The paper's pair of transfers: p2g averages the particles in each voxel, g2p is bilinear interpolation.

Source: Rochman-Sharabi, Lewin & Louppe, arXiv 2408.15753, section 3. p2g is piecewise constant in the positions, so
no gradient flows through it to them; the pair is not adjoint.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer.base import Stencil, Transfer, inside, tensor_product
from nmpm.transfer.linear import linear_g2p, linear_stencil


@dataclass(frozen=True)
class Nearest(Transfer):
    """Voxel averages to the grid, bilinear interpolation back."""

    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        base = inside(cells.detach(), grid).floor().long()
        return tensor_product(base, [torch.ones_like(cells, requires_grad=False)], grid)

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        return linear_stencil(cells, grid)

    def g2p(self, field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        return linear_g2p(field, cells, grid)
