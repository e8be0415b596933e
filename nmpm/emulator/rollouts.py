"""Rollouts: call the emulator bundle after bundle, from one state, for as many frames as asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

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
        after = bundle.state_after(particles)
        if repeated is None and not emulator.training and _is_same_state(particles, after):
            repeated = bundle
        particles = after


def _is_same_state(before: Particles, after: Particles) -> bool:
    """Whether two states have the same motion and fields, to the bit; False where asking would cost."""
    if not can_branch(after.position) or after.position.requires_grad:
        return False
    if not (torch.equal(before.velocity, after.velocity) and torch.equal(before.position, after.position)):
        return False
    earlier = before.fields
    return all(name in earlier and torch.equal(earlier[name], values) for name, values in after.fields.items())


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
    vectors = {name: getattr(particles, name) for name in ("position", "velocity")}
    numbers = {name: values.unsqueeze(-1) for name, values in particles.fields.items()}
    given = {name: values.expand(*real.shape, -1) for name, values in (vectors | numbers).items()}
    states = {name: ~values.isfinite().all(-1) & real for name, values in given.items()}
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
                f" {given[name][scene, particle].tolist()}; it must be finite."
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


class Rollout(NamedTuple):
    """Predicted frames.

    Args:
        position: (B, T, N, D) in domain length.
        fields: (B, T, N) of each evolving field, by name, in its own unit.
    """

    position: Tensor
    fields: Mapping[str, Tensor]

    @classmethod
    def join(cls, parts: Sequence[Rollout]) -> Rollout:
        """Consecutive parts, at least one, as one."""
        names = parts[0].fields
        fields = {name: torch.cat([part.fields[name] for part in parts], dim=1) for name in names}
        return cls(torch.cat([part.position for part in parts], dim=1), fields)

    def cpu(self) -> Rollout:
        """The same on the CPU."""
        return Rollout(self.position.cpu(), {name: values.cpu() for name, values in self.fields.items()})


def stream(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Iterator[Tensor]:
    """Predict `frames` frames without gradients, yielding each bundle's positions as it is made.

    Yields:
        (B, <= m, N, D) positions in domain length; the last bundle is cut to the frames asked for.

    Raises:
        As `stream_rollout`.
    """
    for part in stream_rollout(emulator, particles, frames, monitor):
        yield part.position


def stream_rollout(
    emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None
) -> Iterator[Rollout]:
    """Predict `frames` frames of positions and evolving fields without gradients, yielding each bundle as it is made.

    Yields:
        Up to m frames; the last bundle is cut to the frames asked for.

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
            bundle = next(bundles)
        kept = slice(frames - made)
        fields = {name: values[:, kept] for name, values in bundle.fields.items()}
        part = Rollout(bundle.position[:, kept], fields)
        made += part.position.shape[1]
        yield part


def rollout(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Tensor:
    """Predict `frames` frames without gradients.

    Returns:
        (B, frames, N, D) positions in domain length.

    Raises:
        As `predict_rollout`.
    """
    return predict_rollout(emulator, particles, frames, monitor).position


def predict_rollout(emulator: Emulator, particles: Particles, frames: int, monitor: Monitor | None = None) -> Rollout:
    """Predict `frames` frames of positions and evolving fields without gradients.

    Raises:
        ValueError: if `frames` is negative.
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.
        RolloutStoppedError: if the monitor stops the rollout.
    """
    parts = list(stream_rollout(emulator, particles, frames, monitor))
    if parts:
        return Rollout.join(parts)
    batch, *rest = particles.position.shape
    none = particles.position.new_zeros(batch, 0, *rest)
    return Rollout(none, dict.fromkeys(emulator.scene.evolving, none[..., 0]))
