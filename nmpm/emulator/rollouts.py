"""Rollouts: call the emulator bundle after bundle, from one state, for as many frames as asked."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from nmpm.emulator.model import Bundle, Emulator
from nmpm.emulator.monitor import Monitor
from nmpm.errors import DataError
from nmpm.particles import Particles
from nmpm.scene import Scene


def unroll(emulator: Emulator, particles: Particles, bundles: int, monitor: Monitor | None = None) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, keeping gradients where they are enabled.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
        bundles: How many calls to make.
        monitor: Looks at each bundle before it is handed out.
    """
    if monitor is not None:
        monitor.start(emulator, particles)
    context = emulator.context(particles)
    for _ in range(bundles):
        bundle = emulator(particles, context)
        if monitor is not None:
            monitor.see(emulator, particles, bundle)
        yield bundle
        particles = particles.moved(bundle.position[:, -1], bundle.velocity)


def check_state(scene: Scene, particles: Particles) -> None:
    """Refuse a state that a rollout could only spread or hide.

    Args:
        scene: What it should be a state of.
        particles: The state.

    Raises:
        DataError: naming scene, particle and value, if a position or velocity is not finite, or a position beyond the
            domain's walls.
    """
    real = particles.mask
    for name in ("position", "velocity"):
        values: Tensor = getattr(particles, name)
        bad = ~values.isfinite().all(-1) & real
        if bad.any():
            scene_index, particle = map(int, bad.nonzero()[0])
            raise DataError(
                f"Scene {scene_index} of the batch, particle {particle}: its {name} is"
                f" {values[scene_index, particle].tolist()}; it must be finite."
            )
    beyond = beyond_walls(scene, particles.position) & real
    if beyond.any():
        scene_index, particle = map(int, beyond.nonzero()[0])
        raise DataError(
            f"Scene {scene_index} of the batch, particle {particle}: it is at"
            f" {particles.position[scene_index, particle].tolist()}, outside of the domain {list(scene.domain)}"
            f" ({int(beyond.sum())} particles are)."
        )


def beyond_walls(scene: Scene, position: Tensor) -> Tensor:
    """Which positions (..., D) are outside of the domain, (...) bool: never along periodic axes."""
    lower, upper = position.new_tensor(scene.domain).T
    walls = torch.tensor([not wraps for wraps in scene.periodic], device=position.device)
    beyond: Tensor = (((position < lower) | (position > upper)) & walls).any(-1)
    return beyond


def check_weights(emulator: Emulator) -> None:
    """Refuse an emulator that can only predict nonsense.

    Raises:
        DataError: naming the weight or statistic that holds what is not a finite number.
    """
    for name, values in emulator.state_dict().items():
        if not values.isfinite().all():
            raise DataError(f"The emulator's {name} holds numbers that are not finite: load a sound checkpoint.")


def stream(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Iterator[Tensor]:
    """Predict `frames` frames without gradients, handing out each bundle as it is made.

    Yields:
        (B, <= m, N, D) positions in domain length; the last bundle is cut to the frames asked for.

    Raises:
        ValueError: if `frames` is negative.
        DataError: if the state or a weight holds what is not a finite number, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor says so.
    """
    if frames < 0:
        raise ValueError(f"A rollout has 0 or more frames, not {frames}.")
    check_weights(emulator)
    check_state(emulator.scene, particles)
    bundles = unroll(emulator, particles, -(-frames // emulator.frames), monitor)
    made = 0
    while made < frames:
        with torch.no_grad():  # entered anew for each bundle: a suspended generator must not leak the mode
            position = next(bundles).position[:, : frames - made]
        made += position.shape[1]
        yield position


def rollout(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Tensor:
    """Predict `frames` frames without gradients.

    Returns:
        (B, frames, N, D) positions in domain length.

    Raises:
        ValueError: if `frames` is negative.
        DataError: if the state or a weight holds what is not a finite number, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor says so.
    """
    bundles = list(stream(emulator, particles, frames, monitor))
    if not bundles:
        return particles.position.new_zeros(particles.position.shape[0], 0, *particles.position.shape[1:])
    return torch.cat(bundles, dim=1)
