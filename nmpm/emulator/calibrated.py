"""What a model's calibration says of the inputs that it was trained on, in the units of the data."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from nmpm.emulator.model import UNLIMITED, Emulator
from nmpm.particles import Particles


def calibrated_range(emulator: Emulator, prefix: str) -> tuple[Tensor, Tensor]:
    """Lower and upper limits (D,) of the input channels of that prefix, in length/s; infinite where unlimited."""
    scale = torch.tensor(emulator.grid.spacing, dtype=torch.float64) / emulator.scene.dt
    low, high = (_values(emulator, limit, prefix) for limit in (emulator.input_low, emulator.input_high))
    low = torch.where(low <= -UNLIMITED / 2, -torch.inf, low)
    return low * scale, torch.where(high >= UNLIMITED / 2, torch.inf, high) * scale


def gravity_range(emulator: Emulator) -> tuple[Tensor, Tensor]:
    """Lower and upper limits (D,) of gravity, in length/s², of a model whose scenes differ in it."""
    low, high = calibrated_range(emulator, "gravity_")
    return low / emulator.scene.dt, high / emulator.scene.dt


def usual_gravity(emulator: Emulator) -> Tensor:
    """The gravity (D,) to show a model with whose scenes differ in it, in length/s².

    Downwards along the second axis, as strong as in the root mean square of the training, within the calibrated range.
    """
    scale = torch.tensor(emulator.grid.spacing, dtype=torch.float64) / emulator.scene.dt**2
    mean, std = (_values(emulator, each, "gravity_") * scale for each in (emulator.input_mean, emulator.input_std))
    down = torch.zeros_like(mean)
    down[1] = -(mean.square() + std.square()).sum().sqrt()
    return torch.clamp(down, *gravity_range(emulator))


def with_usual_gravity(emulator: Emulator, state: Particles) -> Particles:
    """A made-up state with the usual gravity where the emulator's scenes differ in it; elsewhere the state itself."""
    if not emulator.scene.gravity_varies:
        return state
    pull = (usual_gravity(emulator) * emulator.scene.dt**2).to(state.gravity)
    return dataclasses.replace(state, gravity=pull.expand(state.gravity.shape))


def _values(emulator: Emulator, statistic: Tensor, prefix: str) -> Tensor:
    """Of a statistic of the input channels, the values (D,) of those of that prefix, in cells, on the CPU."""
    channels = [i for i, name in enumerate(emulator.scene.input_channels) if name.startswith(prefix)]
    return statistic[channels].flatten().cpu().double()
