"""Transfers between particles and grid: the contract, and the two operations every kernel shares.

A kernel gives each particle p a few nodes j and weights w_pj with sum_j w_pj = 1. Then

    scatter (p2g)  S(v)_j = sum_p w_pj v_p          sums over particles, e.g. of mass and momentum
    gather  (g2p)  G(f)_p = sum_j w_pj f_j          interpolation of a grid field

With one kernel both ways the two are adjoint, <S(v), f> = <v, G(f)>. Positions are in cells (see `nmpm.grid`).
Kernel support beyond the last centre of a wall axis is folded onto the border node, so that the weights sum to one
everywhere; on a periodic axis it wraps.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.grid import Grid
from nmpm.transfer.execution import add, chunks

LEAST_SHARE = 1e-30  # of a particle


@dataclass(frozen=True)
class Stencil:
    """Flat indices (B, N, J) int64 of the nodes that each particle touches, and weights (B, N, J) that sum to one."""

    node: Tensor
    weight: Tensor


class Transfer(ABC):
    """A pair of kernels between particles and grid. Subclasses are stateless and give their stencils."""

    @abstractmethod
    def scatter_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        """Nodes and weights for p2g of particles at `cells` (B, N, D)."""

    def gather_stencil(self, cells: Tensor, grid: Grid) -> Stencil:
        """Nodes and weights for g2p at `cells` (B, N, D); unless overridden, those of p2g."""
        return self.scatter_stencil(cells, grid)

    def p2g(self, values: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        """Sum particle values (B, N, C) at `cells` (B, N, D) onto the nodes, (B, C, *S)."""
        first, *others = (
            scatter(self.scatter_stencil(cells[:, chunk], grid), values[:, chunk], grid.size)
            for chunk in chunks(cells.shape[1], cells.device)
        )
        summed = sum(others, start=first)
        return summed.transpose(1, 2).reshape(summed.shape[0], -1, *grid.shape)

    def momentum(self, velocity: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        """Momentum (B, M D, *S) and number (B, M, *S) of each material's particles on the nodes, as `sums`."""
        return self.sums(velocity, membership, cells, grid)

    def sums(self, values: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        """Sums (B, M V, *S) of values (B, N, V) over each material's particles, and their numbers (B, M, *S).

        `membership` (B, N, M) is one at a particle's material and zero elsewhere; all zero for padding.
        """
        by_material = (membership.unsqueeze(-1) * values.unsqueeze(-2)).flatten(-2)
        sums = self.p2g(torch.cat([by_material, membership], dim=-1), cells, grid)
        summed, count = sums.split([by_material.shape[-1], membership.shape[-1]], dim=1)
        return summed, count

    def g2p(self, field: Tensor, cells: Tensor, grid: Grid) -> Tensor:
        """Interpolate a grid field (B, C, *S) at `cells` (B, N, D), (B, N, C)."""
        rows, parts = field.flatten(2).transpose(1, 2), chunks(cells.shape[1], cells.device)
        gathered = [gather(self.gather_stencil(cells[:, chunk], grid), rows) for chunk in parts]
        return torch.cat(gathered, dim=1) if len(gathered) > 1 else gathered[0]


def scatter(stencil: Stencil, values: Tensor, size: int) -> Tensor:
    """Sum particle values (B, N, C) onto `size` nodes, (B, size, C): sum_p w_pj v_p."""
    batch, count, channels = values.shape
    touches = stencil.node.shape[-1]
    source = (stencil.weight.unsqueeze(-1) * values.unsqueeze(2)).reshape(batch, count * touches, channels)
    return add(source, stencil.node.reshape(batch, count * touches), size)


def gather(stencil: Stencil, field: Tensor) -> Tensor:
    """Interpolate a node field (B, size, C) at particles, (B, N, C): sum_j w_pj f_j."""
    batch, count, touches = stencil.node.shape
    channels = field.shape[-1]
    index = stencil.node.reshape(batch, count * touches, 1).expand(-1, -1, channels)
    values = field.gather(1, index).reshape(batch, count, touches, channels)
    return torch.einsum("bnj,bnjc->bnc", stencil.weight, values)


def divisors(count: Tensor) -> Tensor:
    """Numbers of particles, and 1 where so small a share of one is seen that gradients of quotients would overflow."""
    return torch.where(count > LEAST_SHARE, count, 1.0)


def tensor_product(base: Tensor, weights: list[Tensor], grid: Grid) -> Stencil:
    """The stencil of K ** D nodes of a kernel that is a product over axes.

    Along each axis the K tensors of `weights` (B, N, D) are those of the nodes base, base + 1, … with `base` (B, N, D)
    int64 not yet folded or wrapped.
    """
    batch, count, dim = base.shape
    node = base.new_zeros(batch, count, 1)
    weight = weights[0].new_ones(batch, count, 1)
    along = torch.stack(weights, dim=-1)
    steps = torch.arange(len(weights), device=base.device)
    for axis in range(dim):
        extent = grid.shape[axis]
        index = base[..., axis, None] + steps
        index = index.remainder(extent) if grid.periodic[axis] else index.clamp(0, extent - 1)
        node = (node.unsqueeze(-1) * extent + index.unsqueeze(-2)).flatten(-2)
        weight = (weight.unsqueeze(-1) * along[..., axis, None, :]).flatten(-2)
    return Stencil(node, weight)


def inside(cells: Tensor, grid: Grid) -> Tensor:
    """Positions (B, N, D) moved into the domain: wrapped on periodic axes, clamped to the faces of wall axes."""
    columns = [
        column.remainder(extent) if wraps else column.clamp(0, extent)
        for column, extent, wraps in zip(cells.unbind(-1), grid.shape, grid.periodic, strict=True)
    ]
    return torch.stack(columns, dim=-1)
