"""Trivial predictors: an emulator shows skill where its error is below theirs."""

from __future__ import annotations

import torch
from torch import Tensor

from nmpm.particles import Particles
from nmpm.scene import Scene


def still(particles: Particles, frames: int) -> Tensor:
    """Positions (B, frames, N, D) if nothing moves."""
    return particles.position.unsqueeze(1).expand(-1, frames, -1, -1)


def free_fall(scene: Scene, particles: Particles, frames: int) -> Tensor:
    """Every particle flies alone under the scene's gravity and stops at the walls: (B, frames, N, D) positions.

    Frames are equal steps, v_i = v_0 + i g and x_i = x_{i-1} + v_i, as the data's velocities are differences. A
    component that reaches a bound stays there.
    """
    step = torch.arange(1, frames + 1, device=particles.position.device).view(1, -1, 1, 1)
    start, velocity = particles.position.unsqueeze(1), particles.velocity.unsqueeze(1)
    gravity = particles.gravity[:, None, None]
    path = start + velocity * step + gravity * (step * (step + 1) / 2)
    columns = [
        path[..., axis] if scene.periodic[axis] else _stop_at_walls(path[..., axis], *scene.bounds[axis])
        for axis in range(scene.dim)
    ]
    return torch.stack(columns, dim=-1)


def _stop_at_walls(path: Tensor, low: float, high: float) -> Tensor:
    """A path (B, T, N) held at the first bound it reaches; at the lower one if it reaches both at once."""
    frames = torch.arange(path.shape[1], device=path.device).view(1, -1, 1)
    below, above = _first_frame_where(path <= low, frames), _first_frame_where(path >= high, frames)
    held = torch.where(below <= above, torch.full_like(path[:, :1], low), high)
    return torch.where(frames >= torch.minimum(below, above), held, path)


def _first_frame_where(found: Tensor, frames: Tensor) -> Tensor:
    """(B, 1, N): the first of the frames (1, T, 1) at which `found` (B, T, N) holds; T where it never does."""
    return torch.where(found, frames, found.shape[1]).amin(1, keepdim=True)
