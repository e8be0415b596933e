"""Particles as tensors: the state a rollout carries, and the window a training step sees.

Shapes, once for the whole package: B scenes in a batch, N particles (padded to the largest scene), M static
particles (likewise), D space dimensions, T frames. Positions are in domain length, velocities in length per frame
(v_t = p_t - p_{t-1}), gravity in length per frame squared.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor


class _Movable:
    """Dataclasses of tensors that travel together between devices."""

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """The same on another device."""
        moved = {
            field.name: getattr(self, field.name).to(device, non_blocking=non_blocking)
            for field in dataclasses.fields(self)  # type: ignore[arg-type]
        }
        return type(self)(**moved)


@dataclass(frozen=True)
class Particles(_Movable):
    """The state of B scenes at one frame.

    Args:
        position: (B, N, D) in domain length.
        velocity: (B, N, D) in length per frame.
        material: (B, N) int64, index into `Scene.materials`.
        mask: (B, N) bool, False for padding, which changes nothing.
        obstacle: (B, M, D) positions of particles that do not move; M may be 0.
        obstacle_mask: (B, M) bool, False for padding.
        gravity: (B, D) in length per frame squared; zero where unknown.

    Raises:
        ValueError: if the shapes do not fit together.
    """

    position: Tensor
    velocity: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor

    def __post_init__(self) -> None:
        batch, count, dim = self.position.shape
        expected = {
            "velocity": (batch, count, dim),
            "material": (batch, count),
            "mask": (batch, count),
            "obstacle": (batch, self.obstacle.shape[1], dim),
            "obstacle_mask": (batch, self.obstacle.shape[1]),
            "gravity": (batch, dim),
        }
        _check_shapes(self, expected)

    def moved(self, position: Tensor, velocity: Tensor) -> Particles:
        """The same particles elsewhere: (B, N, D) positions and velocities."""
        return dataclasses.replace(self, position=position, velocity=velocity)


@dataclass(frozen=True)
class Window(_Movable):
    """Consecutive recorded frames of B scenes: two to start from, the rest to predict.

    Args:
        frames: (B, T, N, D) positions in domain length, T >= 2.
        material, mask, obstacle, obstacle_mask, gravity: as in `Particles`.

    Raises:
        ValueError: if the shapes do not fit together.
    """

    frames: Tensor
    material: Tensor
    mask: Tensor
    obstacle: Tensor
    obstacle_mask: Tensor
    gravity: Tensor

    def __post_init__(self) -> None:
        batch, frames, count, dim = self.frames.shape
        if frames < 2:
            raise ValueError(f"A window needs at least 2 frames, for a velocity; it has {frames}.")
        expected = {
            "material": (batch, count),
            "mask": (batch, count),
            "obstacle": (batch, self.obstacle.shape[1], dim),
            "obstacle_mask": (batch, self.obstacle.shape[1]),
            "gravity": (batch, dim),
        }
        _check_shapes(self, expected)

    @property
    def initial(self) -> Particles:
        """The state at the window's second frame."""
        return Particles(
            position=self.frames[:, 1],
            velocity=self.frames[:, 1] - self.frames[:, 0],
            material=self.material,
            mask=self.mask,
            obstacle=self.obstacle,
            obstacle_mask=self.obstacle_mask,
            gravity=self.gravity,
        )

    @property
    def target(self) -> Tensor:
        """The frames to predict, (B, T - 2, N, D)."""
        return self.frames[:, 2:]


def _check_shapes(owner: object, expected: dict[str, tuple[int, ...]]) -> None:
    for name, shape in expected.items():
        found = tuple(getattr(owner, name).shape)
        if found != shape:
            raise ValueError(f"{type(owner).__name__}.{name} has shape {found}, expected {shape}.")
