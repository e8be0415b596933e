"""Call after call of an emulator, as the benchmarks make them.

Unlike `nmpm.emulator.unroll`, scenes at rest are called too, and the caller makes the context of the calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from nmpm.emulator import Bundle
from nmpm.particles import Particles


def roll_on(
    predict: Callable[[Particles], Bundle], particles: Particles, bundles: int
) -> Iterator[tuple[Bundle, Particles]]:
    """Predict bundle after bundle, each from the state after the last.

    Args:
        predict: A call from a state.
        particles: The state to start from.
        bundles: How many calls to make.

    Yields:
        Each bundle, and the state after it.
    """
    for _ in range(bundles):
        bundle = predict(particles)
        particles = bundle.state_after(particles)
        yield bundle, particles


def roll_to_end(predict: Callable[[Particles], Bundle], particles: Particles, bundles: int) -> Particles:
    """The state after so many bundles."""
    for _, following in roll_on(predict, particles, bundles):
        particles = following
    return particles
