"""Data augmentation: mirror images and other places of the grid, exact symmetries of scenes, and noise on positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like, rank_slice
from nmpm.emulator import Emulator
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles, Window
from nmpm.scene import Scene

_TOLERANCE = 0.25
"""Cells by which a mirror image's walls may be off: bounds of recorded data are widened by single stray particles."""


def mirror_half(window: Window, scene: Scene, grid: Grid, axes: Sequence[int]) -> Window:
    """The windows, half of them mirrored along each axis; each rank draws for its windows."""
    device = window.frames.device
    for axis in axes:
        draws = rank_slice(lambda rows: torch.rand(rows, device=device), len(window.frames))
        window = mirror_windows(window, axis, _mirror_plane(scene, grid, axis), draws < 0.5)
    return window


def noisy_start(window: Window, deviation: float) -> Particles:
    """The first state with Gaussian noise on its positions, in domain lengths, different on each rank."""
    initial = window.initial
    if deviation <= 0:
        return initial
    return initial.with_motion(initial.position + deviation * normal_like(initial.position), initial.velocity)


def check_mirrors(scene: Scene, axes: Sequence[int]) -> None:
    """Raise ConfigError if a mirror image along an axis is no scene of the same family, by its gravity."""
    for axis in axes:
        if not 0 <= axis < scene.dim:
            raise ConfigError(f"mirror: there is no axis {axis} in a scene of {scene.dim}.")
        if scene.gravity is not None and scene.gravity[axis] and not scene.gravity_varies:
            raise ConfigError(
                f"mirror: along axis {axis} the scene has gravity {scene.gravity[axis]}, so that its mirror image is "
                "another scene; leave the axis out."
            )


def _mirror_plane(scene: Scene, grid: Grid, axis: int) -> float:
    """The middle of the domain, or of the bounds where these are off it, as their images would be other walls."""
    middle, between_walls = (sum(ends[axis]) / 2 for ends in (scene.domain, scene.bounds))
    off = abs(between_walls - middle) > _TOLERANCE / 2 * grid.spacing[axis]
    return between_walls if off and not scene.periodic[axis] else middle


def mirror_windows(window: Window, axis: int, middle: float, mirrored: Tensor) -> Window:
    """Replace those of B windows where `mirrored` (B,) is True by their mirror image about `middle` along an axis."""
    moved = window.obstacle_frames
    return dataclasses.replace(
        window,
        obstacle_frames=None if moved is None else _reflect(moved, axis, middle, mirrored),
        frames=_reflect(window.frames, axis, middle, mirrored),
        obstacle=_reflect(window.obstacle, axis, middle, mirrored),
        gravity=_reflect(window.gravity, axis, 0.0, mirrored),
    )


def check_jitter(scene: Scene, grid: Grid, cells: float) -> None:
    """Raise ConfigError if `cells` is not from 0 to half a cell, or the scene has no wall layer to move the grid in."""
    if not 0 <= cells <= 0.5:
        raise ConfigError(f"model.jitter = {cells} must be from 0 to 0.5: half a cell to each side is all there is.")
    if cells and not any(_room_to_move(scene, grid, cells)):
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
    limits = zip(draws, _room_to_move(emulator.scene, grid, cells), grid.spacing, strict=True)
    return emulator.with_grid_moved([draw * room * spacing for draw, room, spacing in limits])


def _room_to_move(scene: Scene, grid: Grid, cells: float) -> list[float]:
    """By how many cells the grid can be moved along each axis, at most `cells`."""
    rooms = []
    for axis, ((low, high), (outer_low, outer_high)) in enumerate(zip(scene.bounds, scene.domain, strict=True)):
        layer = min(low - outer_low, outer_high - high) / grid.spacing[axis]
        # A little less, so that rounding moves no wall off the grid.
        rooms.append(cells if scene.periodic[axis] else min(cells, layer * (1 - 1e-9)))
    return rooms


def _reflect(values: Tensor, axis: int, middle: float, mirrored: Tensor) -> Tensor:
    """Reflect one component of the vectors (B, …, D) about `middle`, where `mirrored` (B,) is True."""
    reflected = values.clone()
    reflected[..., axis] = 2 * middle - values[..., axis]
    return torch.where(mirrored.reshape(-1, *(1,) * (values.dim() - 1)), reflected, values)
