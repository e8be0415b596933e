"""Data augmentation: mirror images and other places of the grid, exact symmetries of scenes, and noise on positions."""

from __future__ import annotations

import dataclasses
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

_SAME_PLACE = 0.25
"""Cells by which a mirror image's walls may be off: bounds of recorded data are widened by single stray particles."""


@dataclass(frozen=True)
class Augmentation:
    """What training windows are changed by, at random and differently in each step.

    Args:
        mirror: Axes along which half of the windows are mirrored.
        jitter: Cells by which the grid is moved at most, see `with_jitter`.
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
        check_mirrors(scene, grid, self.mirror)
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


def check_mirrors(scene: Scene, grid: Grid, axes: Sequence[int]) -> None:
    """Make sure that a mirror image along each axis is a scene of the same family.

    Raises:
        ConfigError: if an axis does not exist, gravity acts along it and is not an input of the model, or the image's
            walls are elsewhere.
    """
    for axis in axes:
        if not 0 <= axis < scene.dim:
            raise ConfigError(f"mirror: there is no axis {axis} in a scene of {scene.dim}.")
        if scene.gravity is not None and scene.gravity[axis] and not scene.gravity_varies:
            raise ConfigError(
                f"mirror: along axis {axis} the scene has gravity {scene.gravity[axis]}, so that its mirror image is "
                "another scene; leave the axis out."
            )
        (low, high), (outer_low, outer_high) = scene.bounds[axis], scene.domain[axis]
        moved = abs(low + high - outer_low - outer_high) / grid.spacing[axis]
        if moved > _SAME_PLACE and not scene.periodic[axis]:
            raise ConfigError(
                f"mirror: along axis {axis} the bounds {(low, high)} do not lie in the middle of the domain"
                f" {(outer_low, outer_high)}, about which windows are mirrored: walls of the images would be"
                f" {moved:.2g} cells off. Leave the axis out, or give the data a domain with equal layers around the"
                " bounds."
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
    """Make sure that the grid can be moved.

    Raises:
        ConfigError: if `cells` is not from 0 to half a cell, or the scene has no wall layer, so that nothing can move.
    """
    if not 0 <= cells <= 0.5:
        raise ConfigError(f"model.jitter = {cells} must be from 0 to 0.5: half a cell to each side is all there is.")
    if cells and not any(_room(scene, grid, cells)):
        raise ConfigError(
            f"model.jitter = {cells} moves the grid within the wall layer, between bounds and domain, which this scene "
            "lacks: leave it 0, or give the data a larger domain."
        )


def with_jitter(emulator: Emulator, cells: float) -> Emulator:
    """The emulator with its grid moved by up to so many cells along each axis; weights are shared.

    Walls stay on the grid: along axes whose wall layer is narrower it is moved by less. All ranks move it alike, as
    they have the same random state.
    """
    if not cells:
        return emulator
    grid = emulator.grid
    draws = (2 * torch.rand(grid.dim, dtype=torch.float64, device="cpu") - 1).tolist()
    limits = zip(draws, _room(emulator.scene, grid, cells), grid.spacing, strict=True)
    return emulator.with_grid_moved([draw * room * spacing for draw, room, spacing in limits])


def _room(scene: Scene, grid: Grid, cells: float) -> list[float]:
    """By how many cells the grid can be moved along each axis, at most `cells`."""
    rooms = []
    for axis, ((low, high), (outer_low, outer_high)) in enumerate(zip(scene.bounds, scene.domain, strict=True)):
        layer = min(low - outer_low, outer_high - high) / grid.spacing[axis]
        within = layer * (1 - 1e-9)  # so that rounding moves no wall off the grid
        rooms.append(cells if scene.periodic[axis] else min(cells, within))
    return rooms


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
