"""Soft rasterisation of obstacles with parameters: what the grid sees of them is a smooth function of all parameters.

A body is sampled on a lattice of `SAMPLES` points per cell and axis, which does not move with it. Each point counts as
far as it is solid: 1 inside, 0 outside, and smoothly between over a band of `BAND` cells around the outline, by the
body's signed distance d,

    share(d) = 1/2 - 3/4 u + 1/4 u³,  u = 2 d / (BAND · cell), cut to [-1, 1].

The points are interpolated to the grid by the model's own p2g, as particles of obstacles are. So the grid sees what
lattices of particles of all places and directions give on average; contact and support, which read the grid, follow.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.obstacles import Body
from nmpm.scene import Scene

SAMPLES = 3
"""Points along each axis of a cell."""

BAND = 0.5
"""Width of the band, in cells, over which a body's outline is smoothed."""


def sample_bodies(scenes: Sequence[Sequence[Body]], scene: Scene, grid: Grid) -> tuple[Tensor, Tensor]:
    """Obstacle particles with shares that stand for bodies, for `Particles.obstacle` and `.obstacle_share`.

    Where bodies overlap, their union is solid. What is outside of the domain is left out.

    Returns:
        (K, D) points in domain length, of all B scenes together; (B, K) shares of a particle's volume, differentiable
        with respect to the bodies' parameters. Both float64, on the CPU.

    Raises:
        ConfigError: if a body has another number of dimensions than the scene, is impossible, or outside of the domain.
    """
    for body in (body for bodies in scenes for body in bodies):
        if body.dim != grid.dim:
            raise ConfigError(
                f"{type(body).__name__} is a body in {body.dim} dimensions, and this model's scenes have {grid.dim}:"
                " Ramp, Disc and Polygon are for two, Box and Sphere for three."
            )
    points = lattice(grid, SAMPLES)[_near([body for bodies in scenes for body in bodies], grid)]
    solid = torch.stack([_union(bodies, points, grid) for bodies in scenes])
    near = (solid.detach() > 0).any(0)
    volume = grid.cell_volume / SAMPLES**grid.dim
    return points[near], solid[:, near] * (volume / scene.particle_volume)


def solid_share(distance: Tensor, width: float) -> Tensor:
    """1 inside of a body, where signed distances are negative, 0 outside; smooth over a band of some width around 0."""
    u = (2 * distance / width).clamp(-1, 1)
    return 0.5 - 0.75 * u + 0.25 * u**3


def lattice(grid: Grid, samples: int) -> Tensor:
    """(K, D) points over the whole domain, so many per cell and axis, in domain length; float64, on the CPU."""
    axes = [(torch.arange(samples * n, dtype=torch.float64, device="cpu") + 0.5) / samples for n in grid.shape]
    return grid.to_length(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, grid.dim))


def _near(bodies: Sequence[Body], grid: Grid) -> Tensor:
    """(K,) bool: the points of the lattice in cells that bodies may reach into, judged by the cells' centres."""
    centres, spacing = lattice(grid, 1), torch.tensor(grid.spacing, dtype=torch.float64)
    reach = (BAND * spacing.amin() + spacing.norm()) / 2
    near = torch.zeros(len(centres), dtype=torch.bool)
    with torch.no_grad():
        for body in bodies:
            near |= body.distance(centres) <= reach
    near = near.reshape(grid.shape)
    for axis in range(grid.dim):
        near = near.repeat_interleave(SAMPLES, axis)
    return near.reshape(-1)


def _union(bodies: Sequence[Body], points: Tensor, grid: Grid) -> Tensor:
    """(K,) how solid each point is."""
    width = BAND * min(grid.spacing)
    shares = []
    for body in bodies:
        share = solid_share(body.distance(points), width)
        if not bool((share.detach() > 0).any()):
            raise ConfigError(
                f"{type(body).__name__}: no part of it is within the domain, or it is far thinner than a cell."
            )
        shares.append(share)
    return torch.stack(shares).amax(0) if shares else points.new_zeros(len(points))
