"""Data augmentation: mirror images and other places of the grid, exact symmetries of scenes, and noise on positions."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like, rank_slice
from nmpm.emulator import Emulator
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles, Window
from nmpm.scene import Scene


@dataclass(frozen=True)
class Augmentation:
    """What training windows are changed by, at random and differently in each step.

    Args:
        mirror: Axes along which half of the windows are mirrored.
        jitter: Cells by which the grid is moved at most.
        position_noise: Standard deviation of the noise on initial positions, in domain lengths.
    """

    mirror: tuple[int, ...] = ()
    jitter: float = 0.0
    position_noise: float = 0.0

    def check(self, scene: Scene, grid: Grid) -> None:
        """Make sure that a scene and its grid allow the changes.

        Raises:
            ConfigError: as `check_mirrors` and `check_jitter`.
        """
        check_mirrors(scene, self.mirror)
        check_jitter(scene, grid, self.jitter)

    def mirrored(self, window: Window, scene: Scene) -> Window:
        """The windows, half of them mirrored along each axis; ranks draw for their own ones."""
        device = window.frames.device
        for axis in self.mirror:
            draws = rank_slice(lambda rows: torch.rand(rows, device=device), len(window.frames))
            window = mirror_windows(window, scene, axis, draws < 0.5)
        return window

    def start(self, window: Window) -> Particles:
        """The state that predictions start from, with noise."""
        return with_position_noise(window.initial, self.position_noise)

    def jittered(self, emulator: Emulator) -> Emulator:
        """The emulator with its grid at another place."""
        return with_jitter(emulator, self.jitter)


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


def check_jitter(scene: Scene, grid: Grid, cells: float) -> None:
    """Make sure that the grid can be moved by so many cells and still covers the scene.

    Raises:
        ConfigError: naming the axis, and the room between a wall and the domain's end.
    """
    for axis, ((low, high), (outer_low, outer_high)) in enumerate(zip(scene.bounds, scene.domain, strict=True)):
        room = min(low - outer_low, outer_high - high) / grid.spacing[axis]
        if not 0 <= cells <= (0.5 if scene.periodic[axis] else min(room, 0.5)):
            raise ConfigError(
                f"model.jitter = {cells} must be from 0 to half a cell, and walls must stay on the grid: axis {axis} "
                f"leaves {math.floor(100 * room) / 100:g} cells."
            )


def with_jitter(emulator: Emulator, cells: float) -> Emulator:
    """The emulator with its grid moved by up to so many cells along each axis; weights are shared.

    All ranks move it alike, as they have the same random state.
    """
    if not cells:
        return emulator
    draws = cells * (2 * torch.rand(emulator.grid.dim, dtype=torch.float64, device="cpu") - 1)
    return emulator.with_grid_moved([d * h for d, h in zip(draws.tolist(), emulator.grid.spacing, strict=True)])


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
