"""Data augmentation: mirror images, which are exact symmetries of scenes, and noise on positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.errors import ConfigError
from nmpm.particles import Particles, Window
from nmpm.scene import Scene


def check_mirrors(scene: Scene, axes: Sequence[int]) -> None:
    """Make sure that a mirror image along each axis is a scene of the same family.

    Raises:
        ConfigError: if an axis does not exist, or gravity acts along it and is not an input of the model.
    """
    for axis in axes:
        if not 0 <= axis < scene.dim:
            raise ConfigError(f"mirror: there is no axis {axis} in a scene of {scene.dim}.")
        if scene.gravity is not None and scene.gravity[axis] and not scene.gravity_varies:
            raise ConfigError(
                f"mirror: along axis {axis} the scene has gravity {scene.gravity[axis]}, so that its mirror image is "
                "another scene; leave the axis out."
            )


def mirror_windows(window: Window, scene: Scene, axis: int, chosen: Tensor) -> Window:
    """Replace some windows by their mirror image along an axis, about the domain's middle.

    Args:
        window: B windows.
        scene: Gives the domain.
        axis: Which axis to mirror.
        chosen: (B,) bool, which windows to mirror.
    """
    middle = sum(scene.domain[axis]) / 2
    return dataclasses.replace(
        window,
        frames=_reflect(window.frames, axis, middle, chosen),
        obstacle=_reflect(window.obstacle, axis, middle, chosen),
        gravity=_reflect(window.gravity, axis, 0.0, chosen),
    )


def with_position_noise(particles: Particles, deviation: float) -> Particles:
    """The same particles with Gaussian noise of this standard deviation, in domain lengths, on their positions.

    Ranks draw different noise; see `normal_like`.
    """
    if deviation <= 0:
        return particles
    noise = deviation * normal_like(particles.position)
    return particles.with_motion(particles.position + noise, particles.velocity)


def _reflect(values: Tensor, axis: int, middle: float, chosen: Tensor) -> Tensor:
    """Reflect one component of the chosen vectors (B, …, D) about `middle`."""
    reflected = values.clone()
    reflected[..., axis] = 2 * middle - values[..., axis]
    return torch.where(chosen.reshape(-1, *(1,) * (values.dim() - 1)), reflected, values)
