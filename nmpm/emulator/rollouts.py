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
from nmpm.transfer.chunks import can_branch


def unroll(emulator: Emulator, particles: Particles, bundles: int, monitor: Monitor | None = None) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, keeping gradients where they are enabled.

    Once a bundle ends in exactly the state that it started from, as a scene at rest does, all further ones would be the
    same: it is yielded again without a call. Only on a CPU, as comparing states elsewhere would halt the device.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
        bundles: How many calls to make.
        monitor: Measures each bundle before it is yielded.
    """
    if monitor is not None:
        monitor.start(emulator, particles)
    context = emulator.context(particles)
    repeated: Bundle | None = None
    for remaining in reversed(range(bundles)):
        bundle = emulator(particles, context) if repeated is None else repeated
        if monitor is not None:
            monitor.see(emulator, particles, bundle)
            if not remaining:
                monitor.read()
        yield bundle
        after = particles.with_motion(bundle.position[:, -1], bundle.velocity)
        if repeated is None and not emulator.training and _is_same_motion(particles, after):
            repeated = bundle
        particles = after


def _is_same_motion(before: Particles, after: Particles) -> bool:
    """Whether two states have the same positions and velocities, to the bit; False where asking would cost."""
    if not can_branch(after.position) or after.position.requires_grad:
        return False
    return torch.equal(before.velocity, after.velocity) and torch.equal(before.position, after.position)


def check_inputs(emulator: Emulator, particles: Particles) -> None:
    """Reject emulators with non-finite weights, and states that are non-finite or outside of the domain.

    All checks are read back from the device at once; details are computed only if one fails.

    Args:
        emulator: Is to predict.
        particles: The state to start from.

    Raises:
        DataError: naming the weight or statistic; or scene, particle and value.
    """
    real = particles.mask
    states = {name: ~getattr(particles, name).isfinite().all(-1) & real for name in ("position", "velocity")}
    beyond = beyond_walls(emulator.scene, particles.position) & real
    weights = emulator.state_dict()
    unsound = [~values.isfinite().all() for values in weights.values()]
    checks = [torch.stack(unsound).any(), *(bad.any() for bad in states.values()), beyond.any()]
    if not bool(torch.stack(checks).any()):
        return
    for name, bad in zip(weights, unsound, strict=True):
        if bad:
            raise DataError(f"The emulator's {name} holds values that are not finite: load a sound checkpoint.")
    for name, bad in states.items():
        if bad.any():
            scene, particle = map(int, bad.nonzero()[0])
            raise DataError(
                f"Scene {scene} of the batch, particle {particle}: its {name} is"
                f" {getattr(particles, name)[scene, particle].tolist()}; it must be finite."
            )
    scene, particle = map(int, beyond.nonzero()[0])
    raise DataError(
        f"Scene {scene} of the batch, particle {particle}: it is at {particles.position[scene, particle].tolist()},"
        f" outside of the domain {list(emulator.scene.domain)} ({int(beyond.sum())} particles are)."
    )


def beyond_walls(scene: Scene, position: Tensor) -> Tensor:
    """Whether positions (..., D) are outside of the domain, (...) bool: never along periodic axes."""
    sides = [
        torch.zeros_like(column, dtype=torch.bool) if wraps else (column < low) | (column > high)
        for column, (low, high), wraps in zip(position.unbind(-1), scene.domain, scene.periodic, strict=True)
    ]
    return torch.stack(sides).any(0)


def stream(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Iterator[Tensor]:
    """Predict `frames` frames without gradients, yielding each bundle as it is made.

    Yields:
        (B, <= m, N, D) positions in domain length; the last bundle is cut to the frames asked for.

    Raises:
        ValueError: if `frames` is negative.
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor stops the rollout.
    """
    if frames < 0:
        raise ValueError(f"A rollout has 0 or more frames, not {frames}.")
    check_inputs(emulator, particles)
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
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor stops the rollout.
    """
    bundles = list(stream(emulator, particles, frames, monitor))
    if not bundles:
        return particles.position.new_zeros(particles.position.shape[0], 0, *particles.position.shape[1:])
    return torch.cat(bundles, dim=1)
