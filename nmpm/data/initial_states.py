"""States to start a rollout from when there is no recording at hand: blocks of particles, thrown into the box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nmpm.particles import Particles
from nmpm.scene import Interval, Scene


def thrown_blocks(scene: Scene, count: int = 1000, blocks: int = 1, speed: float = 1.0, seed: int = 0) -> Particles:
    """Square blocks (cubes) of particles on a lattice at the scene's own density, side by side along the first axis.

    About `count` particles in all, of the scene's materials in turn, with random velocities up to `speed` in length per
    second along each axis: one scene (B = 1) without obstacles.

    Raises:
        ValueError: if the blocks do not fit into the box.
    """
    rng = np.random.default_rng(seed)
    spacing = scene.particle_spacing
    side = max(1, round((count / blocks) ** (1 / scene.dim)))
    low, high = np.array(scene.bounds).T
    room = (high - low) / np.array([blocks] + [1] * (scene.dim - 1)) - side * spacing
    if room.min() < 0:
        raise ValueError(
            f"{blocks} blocks of {side**scene.dim} particles, {side * spacing:.3g} wide, overfill the box."
        )
    nodes = np.indices((side,) * scene.dim).reshape(scene.dim, -1).T
    lattice = spacing * (nodes + 0.5)
    shift = np.eye(scene.dim)[0] * (high - low)[0] / blocks
    corners = low + rng.uniform(0, room, (blocks, scene.dim)) + np.arange(blocks)[:, None] * shift
    position = torch.from_numpy((corners[:, None] + lattice).reshape(1, -1, scene.dim)).float()
    thrown = np.repeat(rng.uniform(-speed, speed, (blocks, scene.dim)) * scene.dt, len(lattice), axis=0)
    material = torch.arange(blocks).remainder(len(scene.materials)).repeat_interleave(len(lattice))[None]
    return _state(scene, position, torch.from_numpy(thrown[None]).float(), material)


def lattice(box: Sequence[Interval], spacing: float) -> Tensor:
    """(N, D) points that fill a box, about `spacing` apart, in domain length."""
    numbers = [max(1, round((high - low) / spacing)) for low, high in box]
    axes = [
        low + (high - low) * (torch.arange(n, dtype=torch.float64) + 0.5) / n
        for (low, high), n in zip(box, numbers, strict=True)
    ]
    return torch.cartesian_prod(*axes).reshape(-1, len(axes)).float()


def state_at_rest(scene: Scene, position: Tensor, obstacle: Tensor | None = None) -> Particles:
    """Particles (N, D) of the first material at rest, and perhaps obstacle particles (M, D): one scene (B = 1)."""
    material = torch.zeros(1, len(position), dtype=torch.int64)
    return _state(scene, position[None], torch.zeros_like(position)[None], material, obstacle)


def _state(
    scene: Scene, position: Tensor, velocity: Tensor, material: Tensor, obstacle: Tensor | None = None
) -> Particles:
    solid = position.new_zeros(1, 0, scene.dim) if obstacle is None else obstacle[None]
    return Particles(
        position=position,
        velocity=velocity,
        material=material,
        mask=torch.ones_like(material, dtype=torch.bool),
        obstacle=solid,
        obstacle_mask=torch.ones(1, solid.shape[1], dtype=torch.bool),
        gravity=torch.tensor(scene.gravity or (0.0,) * scene.dim)[None] * scene.dt**2,
    )
