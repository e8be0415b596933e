"""Data augmentation by exact symmetries of scenes: mirror images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.particles import Window
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


def _reflect(values: Tensor, axis: int, middle: float, chosen: Tensor) -> Tensor:
    """Reflect one component of the chosen vectors (B, …, D) about `middle`."""
    reflected = values.clone()
    reflected[..., axis] = 2 * middle - values[..., axis]
    return torch.where(chosen.reshape(-1, *(1,) * (values.dim() - 1)), reflected, values)
