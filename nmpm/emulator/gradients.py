"""Rollouts that keep gradients: of any loss with respect to the initial state, obstacles and gravity."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nmpm._support.numbers import check_whole
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.model import Emulator
from nmpm.emulator.periods import Periods
from nmpm.emulator.rollouts import check_inputs, warn_of_training_mode
from nmpm.particles import Particles

Call = Callable[[Emulator, Particles, RolloutContext], Bundle]


def unroll_with_gradients(
    emulator: Emulator,
    particles: Particles,
    bundles: int,
    call: Call,
    state_after: Callable[[Bundle, Particles], Particles] = Bundle.state_after,
) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, with gradients.

    Args:
        emulator: Predicts m frames a call.
        particles: The state to start from.
        bundles: How many calls to make.
        call: Makes one, such as `recomputed`.
        state_after: What the next call starts from, of a bundle and of what it started from.
    """
    context = emulator.context(particles)
    for _ in range(bundles):
        bundle = call(emulator, particles, context)
        yield bundle
        particles = state_after(bundle, particles)


def recomputed(emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
    """A call of the emulator that keeps no activations: backward passes compute it again.

    The memory of several is that of one and of the states between them, for the time of one more forward pass.
    """
    bundle: Bundle = checkpoint(emulator, particles, context, use_reentrant=False)
    return bundle


def differentiable_rollout(emulator: Emulator, particles: Particles, frames: int) -> Tensor:
    """Predict `frames` frames with gradients to the state: its positions, velocities, obstacles and gravity.

    The trajectories of liquids are chaotic: over long rollouts gradients grow without bound and say less and less.
    Optimise over the shortest horizon that the purpose allows, clip gradients, or average them over several slightly
    different states of a batch.

    Args:
        emulator: In evaluation mode; its own parameters should not require gradients
            (`emulator.requires_grad_(False)`), which saves time.
        particles: The state to start from, see `Pretrained.state`, which keeps gradients of what it is given.
        frames: How many frames to predict, at least 1.

    Returns:
        (B, frames, N, D) positions in domain length.

    Raises:
        ConfigError: if `frames` is below 1, or no whole number.
        DataError: if the state or a weight is not finite, or a particle is outside of the domain.

    Warns:
        UserWarning: if the emulator is in training mode, in which constraints do not act.
    """
    frames = check_whole("frames", frames, 1)
    warn_of_training_mode(emulator)
    with torch.no_grad():
        check_inputs(emulator, particles)
    periods = Periods(emulator)
    bundles = unroll_with_gradients(
        emulator,
        periods.wrap(particles),
        -(-frames // emulator.frames),
        recomputed,
        lambda bundle, start: periods.wrap(bundle.state_after(start)),
    )
    return torch.cat([periods.unwrapped(bundle).position for bundle in bundles], dim=1)[:, :frames]
