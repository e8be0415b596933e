"""Rasterising particles to the grid state that the processor sees: per material the mean velocity and the volume
fraction, then the other channels of the scene (`Scene.input_channels`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.emulator.fields import FieldScales
from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.transfer import Transfer, divisors


def grid_state(
    scene: Scene, grid: Grid, transfer: Transfer, particles: Particles, cells: Tensor, velocity: Tensor, solid: Tensor,
    scales: FieldScales | None = None,
) -> Tensor:  # fmt: skip
    """The grid state in grid units, (B, C_in, *S).

    Particles are at `cells` (B, N, D) with `velocity` (B, N, D) in cells per frame, among `solid` (B, C_solid, *S).
    They weigh by their volumes. Scenes with fields need their scales.
    """
    index = torch.arange(len(scene.materials), device=particles.material.device)
    membership = ((particles.material.unsqueeze(-1) == index) & particles.mask.unsqueeze(-1)).float()
    if particles.volume is not None:
        membership = membership * particles.volume.to(cells.dtype).unsqueeze(-1)
    momentum, count = transfer.momentum(velocity, membership, cells, grid)
    mean = momentum / divisors(count).repeat_interleave(scene.dim, dim=1)
    volume = count * (scene.particle_volume / grid.cell_volume)
    parts = [mean, volume, solid_channels(scene, grid, transfer, particles, solid, cells.dtype)]
    if scene.gravity_varies:
        parts.append(_constant(grid.to_cell_displacement(particles.gravity, cells.dtype), grid))
    if scales is not None and scene.particle_fields:
        values = scales.of_particles(particles)
        sums, count = transfer.sums(values, membership.to(values.dtype), cells, grid)
        parts.append(sums / divisors(count).repeat_interleave(values.shape[-1], dim=1))
    if scales is not None and scene.parameters:
        parts.append(_constant(scales.of_scene(particles), grid))
    return torch.cat(parts, dim=1)


def _constant(values: Tensor, grid: Grid) -> Tensor:
    """(B, C) values on all of the grid, (B, C, *S)."""
    return values.reshape(*values.shape, *(1,) * grid.dim).expand(-1, -1, *grid.shape)


def solid_fraction(scene: Scene, grid: Grid, transfer: Transfer, particles: Particles, walls: Tensor) -> Tensor:
    """The share of each cell taken by walls (*S) and obstacles, (B, 1, *S) in [0, 1]; (B, 0, *S) in unwalled scenes."""
    batch = particles.position.shape[0]
    if not scene.walled:
        return walls.new_zeros(batch, 0, *grid.shape)
    if not scene.obstacles:
        return walls.expand(batch, 1, *grid.shape)
    precision = torch.promote_types(walls.dtype, torch.float32)
    cells = grid.to_cells(particles.obstacle, precision)
    volume = _obstacle_volumes(particles, precision)
    return (walls + volume_fraction(scene, grid, transfer, volume, cells)).clamp(max=1.0)


def solid_channels(
    scene: Scene, grid: Grid, transfer: Transfer, particles: Particles, solid: Tensor, dtype: torch.dtype
) -> Tensor:
    """The grid state's channels of solids (B, C, *S): `solid`, and where obstacles move their mean velocity."""
    if not scene.moving_obstacles:
        return solid
    return torch.cat([solid, _solid_velocity(grid, transfer, particles, dtype)], dim=1)


def _solid_velocity(grid: Grid, transfer: Transfer, particles: Particles, dtype: torch.dtype) -> Tensor:
    """The mean velocity of the obstacles in each cell, by volume, (B, D, *S) in cells per frame; 0 where none is."""
    cells, volume = grid.to_cells(particles.obstacle, dtype), _obstacle_volumes(particles, dtype).unsqueeze(-1)
    if particles.obstacle_velocity is None:
        return cells.new_zeros(len(cells), grid.dim, *grid.shape)
    velocity = grid.to_cell_displacement(particles.obstacle_velocity, dtype)
    sums = transfer.p2g(torch.cat([velocity * volume, volume], dim=-1), cells, grid)
    return sums[:, :-1] / divisors(sums[:, -1:])


def _obstacle_volumes(particles: Particles, dtype: torch.dtype) -> Tensor:
    """(B, M) volumes of the obstacles' particles, as multiples of a particle's; 0 for padding."""
    real = particles.obstacle_mask.to(dtype)
    return real if particles.obstacle_share is None else real * particles.obstacle_share.to(dtype)


def volume_fraction(scene: Scene, grid: Grid, transfer: Transfer, volume: Tensor, cells: Tensor) -> Tensor:
    """The share of each cell taken by particles at `cells` (B, N, D), (B, 1, *S); above 1 where they are crowded.

    `volume` (B, N) is how much of the scene's particle volume each stands for: a mask, shares or `present_volume`.
    """
    count = transfer.p2g(volume.to(cells.dtype).unsqueeze(-1), cells, grid)
    return count * (scene.particle_volume / grid.cell_volume)


def wall_fraction(scene: Scene, grid: Grid) -> Tensor:
    """The share of each cell beyond the scene's walls, (*S), exact for the box; on torch's default device.

    Computed in float64, which not every device has, on the CPU.
    """
    free = torch.ones((), dtype=torch.float64, device="cpu")
    for axis, (low, high) in enumerate(scene.bounds):
        centre = grid.centres(axis)
        half = grid.spacing[axis] / 2
        overlap = (centre + half).clamp(max=high) - (centre - half).clamp(min=low)
        share = (overlap / grid.spacing[axis]).clamp(0, 1) if scene.confined[axis] else torch.ones_like(overlap)
        free = free.unsqueeze(-1) * share
    return (1 - free).float().to(torch.get_default_device())
