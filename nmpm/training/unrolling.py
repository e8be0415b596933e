"""The calls of a training step, through which gradients come back discounted.

The flow of a splash parts neighbours exponentially, and so do gradients grow that go back through it: what a later
bundle says of an earlier one is mostly noise (`benchmarks/gradient_shares.py`). Discounted, it counts less, and later
bundles still train the weights by their own errors in full.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nmpm.emulator import Bundle, Emulator, RolloutContext
from nmpm.emulator.rollouts import Call, unroll_with_gradients
from nmpm.errors import ConfigError
from nmpm.particles import Particles


def unroll_training(
    emulator: Emulator, particles: Particles, bundles: int, call: Call, discount: Discount
) -> Iterator[Bundle]:
    """Predict bundle after bundle, each from the last, with discounted gradients.

    Args:
        emulator: In training mode.
        particles: The state to start from.
        bundles: K, how many calls to make.
        call: Makes one: `direct`, or `nmpm.emulator.rollouts.recomputed` to save memory.
        discount: Hands states from bundle to bundle.
    """
    return unroll_with_gradients(
        emulator, particles, bundles, call, lambda bundle, before: discount(bundle.state_after(before))
    )


def direct(emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
    """A call of the emulator that keeps its activations for the backward pass."""
    bundle: Bundle = emulator(particles, context)
    return bundle


@dataclass(frozen=True)
class Discount:
    """Hands a state on to the next bundle, through which gradients come back smaller.

    Args:
        factor: In [0, 1], on gradients from one bundle to the one before: 1 changes nothing, 0 cuts them.

    Raises:
        ConfigError: if the factor is not in that range.
    """

    factor: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.factor <= 1:
            raise ConfigError(f"model.gradient_discount = {self.factor} must be in [0, 1].")

    def __call__(self, particles: Particles) -> Particles:
        """The same values; their gradients are multiplied by the factor, and cut for 0."""
        if self.factor == 1:
            return particles
        moved = particles.with_motion(self._pass_on(particles.position), self._pass_on(particles.velocity))
        fields = {name: self._pass_on(values) for name, values in particles.fields.items()}
        return moved.with_fields(fields) if fields else moved

    def _pass_on(self, values: Tensor) -> Tensor:
        if self.factor == 0:
            return values.detach()
        passed: Tensor = _Scale.apply(values, self.factor)  # type: ignore[no-untyped-call]  # (torch's stubs)
        return passed


class _Scale(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        return ctx.factor * slope, None
