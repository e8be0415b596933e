"""Quadratic B-spline transfers: one kernel both ways, 3 nodes per axis, continuous gradients.

With `Quadratic` a particle brings only its velocity, which smooths what it scatters: a rotating disc loses spin. With
its own gradient C_p, as in `Affine`,

    (m u)_j = sum_p w_pj (v_p + C_p (x_j - x_p)),

linear velocity fields arrive on the grid as they are. Momentum is conserved, as sum_j w_pj (x_j - x_p) = 0 for any
kernel if x_p stands for the centre of its own weights (the same place, except beside walls). Particles of recordings
have no gradient, so it is fitted anew in each call: at each node by least squares over the particles that touch it,
then gathered back to the particles, by mass.

Sources: the kernel of most material point methods, e.g. Jiang et al., The Material Point Method for Simulating
Continuum Materials, SIGGRAPH 2016 courses, eq. 123; APIC: Jiang et al., The affine particle-in-cell method, SIGGRAPH
2015; the fit: moving least squares, as in Hu et al., A moving least squares material point method, SIGGRAPH 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.transfer.transfer import Stencil, Transfer, divisors, gather, inside, scatter, tensor_product


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


@dataclass(frozen=True)
class Affine(Quadratic):
    """Quadratic B-splines both ways, velocities with their gradient.

    Args:
        damping: Added to the particles' variance about each node, in cells², so that a few particles in a row or close
            together do not fit steep slopes to their noise. With 0 linear fields are exact to rounding.
    """

    damping: float = 1e-3

    def __post_init__(self) -> None:
        if not 0 <= self.damping < float("inf"):
            raise ConfigError(f"Affine.damping = {self.damping} must not be negative.")

    def momentum(self, velocity: Tensor, membership: Tensor, cells: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        stencil, places = self.scatter_stencil(cells, grid), quadratic_places(cells, grid)
        centre = torch.einsum("bnj,bnjd->bnd", stencil.weight, places)
        offset = places - centre.unsqueeze(2)
        apart = inside(cells, grid).unsqueeze(2) - places
        slope, count = self._slopes(velocity, membership, stencil, apart, grid)
        gradient = _own(slope, count, membership, stencil)
        at_nodes = velocity.unsqueeze(2) + torch.einsum("bnde,bnje->bnjd", gradient, offset)
        values = torch.einsum("bnm,bnjd->bnjmd", membership, at_nodes).flatten(-2)
        sums = (_scattered(stencil, values, grid.size), count)
        momentum, number = (each.transpose(1, 2).reshape(each.shape[0], -1, *grid.shape) for each in sums)
        return momentum, number

    def _slopes(
        self, velocity: Tensor, membership: Tensor, stencil: Stencil, apart: Tensor, grid: Grid
    ) -> tuple[Tensor, Tensor]:
        """At each node the slopes (B, S, M, D, D) of the velocity, fitted over particles, and their number (B, S, M).

        The fit's variables are the particles' offsets (B, N, J, D) from each node, so that nothing large cancels.
        """
        dim, materials = velocity.shape[-1], membership.shape[-1]
        touches = apart.shape[2]
        one = torch.ones_like(apart[..., :1])
        moved = velocity.unsqueeze(2).expand(-1, -1, touches, -1)
        squares = (apart.unsqueeze(-1) * apart.unsqueeze(-2)).flatten(-2)
        products = (moved.unsqueeze(-1) * apart.unsqueeze(-2)).flatten(-2)
        terms = torch.cat([one, apart, moved, squares, products], dim=-1)
        values = (membership[:, :, None, :, None] * terms.unsqueeze(-2)).flatten(-2)
        sums = _scattered(stencil, values, grid.size).unflatten(-1, (materials, -1))
        count, place_sum, moved_sum, square_sum, product_sum = sums.split([1, dim, dim, dim**2, dim**2], dim=-1)
        total = divisors(count)
        mean, flow = place_sum / total, moved_sum / total
        variance = (square_sum / total).unflatten(-1, (dim, dim)) - mean.unsqueeze(-1) * mean.unsqueeze(-2)
        covariance = (product_sum / total).unflatten(-1, (dim, dim)) - flow.unsqueeze(-1) * mean.unsqueeze(-2)
        # Rounding must not make a variance singular where all particles are in one apart.
        floor = max(self.damping, 16 * torch.finfo(velocity.dtype).eps)
        damped = variance + floor * torch.eye(dim, dtype=variance.dtype, device=variance.device)
        return covariance @ torch.linalg.inv_ex(damped).inverse, count.squeeze(-1)


def _own(slope: Tensor, count: Tensor, membership: Tensor, stencil: Stencil) -> Tensor:
    """(B, N, D, D) the slopes at each particle, of its own material, by mass."""
    batch, size, materials, dim, _ = slope.shape
    weighted = torch.cat([count.unsqueeze(-1) * slope.flatten(-2), count.unsqueeze(-1)], dim=-1)
    gathered = gather(stencil, weighted.reshape(batch, size, -1)).unflatten(-1, (materials, -1))
    weighted_sum: Tensor = (gathered * membership.unsqueeze(-1)).sum(dim=-2)
    summed, mass = weighted_sum.split([dim**2, 1], dim=-1)
    mean: Tensor = (summed / divisors(mass)).unflatten(-1, (dim, dim))
    return mean


def _scattered(stencil: Stencil, values: Tensor, size: int) -> Tensor:
    """Sum values (B, N, J, C) that differ from node to node, (B, size, C)."""
    one_each = Stencil(stencil.node.flatten(1).unsqueeze(-1), stencil.weight.flatten(1).unsqueeze(-1))
    return scatter(one_each, values.flatten(1, 2), size)
