"""Rollouts: call the emulator bundle after bundle, from one state, for as many frames as asked."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from nmpm.emulator import Bundle, Emulator
from nmpm.particles import Particles


def unroll(emulator: Emulator, particles: Particles, bundles: int) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, keeping gradients where they are enabled.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
        bundles: How many calls to make.
    """
    solid = emulator.solid(particles)
    for _ in range(bundles):
        bundle = emulator(particles, solid)
        yield bundle
        particles = particles.moved(bundle.position[:, -1], bundle.velocity)


def stream(emulator: Emulator, particles: Particles, frames: int) -> Iterator[Tensor]:
    """Predict `frames` frames without gradients, handing out each bundle as it is made.

    Yields:
        (B, <= m, N, D) positions in domain length; the last bundle is cut to the frames asked for.

    Raises:
        ValueError: if `frames` is negative.
    """
    if frames < 0:
        raise ValueError(f"A rollout has 0 or more frames, not {frames}.")
    bundles = unroll(emulator, particles, -(-frames // emulator.frames))
    made = 0
    while made < frames:
        with torch.no_grad():  # entered anew for each bundle: a suspended generator must not leak the mode
            position = next(bundles).position[:, : frames - made]
        made += position.shape[1]
        yield position


def rollout(emulator: Emulator, particles: Particles, frames: int) -> Tensor:
    """Predict `frames` frames without gradients.

    Returns:
        (B, frames, N, D) positions in domain length.

    Raises:
        ValueError: if `frames` is negative.
    """
    bundles = list(stream(emulator, particles, frames))
    if not bundles:
        return particles.position.new_zeros(particles.position.shape[0], 0, *particles.position.shape[1:])
    return torch.cat(bundles, dim=1)
