"""Initial states: ranges from which rectangular blocks are drawn, the same keys for every solver, and gravity."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from nmpm.sim.state import Array, check


@dataclass(frozen=True)
class BlockRanges:
    """How blocks are drawn; lengths in metres.

    Args:
        number: Least and most blocks in a scene.
        particles: Least and most particles in a scene, all blocks together.
        share: Least part of the particles in one block.
        aspect: Least and largest height over width.
        gap: Least distance between blocks, and from the box's sides.
        speed: Largest initial velocity along each axis, in length per second.
        jitter: Largest displacement of a particle off the lattice along each axis, in spacings.

    Raises:
        ConfigError: if a range is empty or a value is out of range.
    """

    number: tuple[int, int]
    particles: tuple[int, int]
    share: float
    aspect: tuple[float, float]
    gap: float
    speed: float
    jitter: float

    def __post_init__(self) -> None:
        for key in ("number", "particles", "aspect"):
            low, high = getattr(self, key)
            check(0 < low <= high, f"blocks.{key} = {[low, high]} needs two positive numbers, the lower first.")
        check(0 < self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        check(0 <= self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be at least 0 and below 0.5.")
        check(self.gap >= 0 and self.speed >= 0, "blocks.gap and blocks.speed must not be negative.")

    def faster(self, factor: float) -> Self:
        """The same at initial speeds times a factor."""
        return dataclasses.replace(self, speed=factor * self.speed)

    def multiplied(self, times: int) -> Self:
        """For a box so many times as large: up to as many times as many particles and blocks."""
        return dataclasses.replace(
            self,
            particles=(self.particles[0], times * self.particles[1]),
            number=(self.number[0], times * self.number[1]),
            share=self.share / times,
        )


def lattice(low: Array, shape: tuple[int, ...], spacing: float, shift: Array | float = 0.0) -> Array:
    """(N, D) centres of the cells of a lattice, the last axis varying fastest.

    Args:
        low: (D,) its lower corner, in length.
        shape: Cells along each axis.
        spacing: Side of a cell, in length.
        shift: (N, D) displacement of each point, in spacings.
    """
    nodes = np.stack(np.meshgrid(*(np.arange(number) for number in shape), indexing="ij"), axis=-1)
    return np.asarray(low + spacing * (nodes.reshape(-1, len(shape)) + 0.5 + shift))


def draw_gravity(gravity: tuple[float, ...], max_turn: float, rng: np.random.Generator) -> tuple[float, ...]:
    """A gravity of two axes, turned by a random angle of at most `max_turn` degrees; unchanged for 0."""
    if not max_turn:
        return gravity
    angle = math.radians(rng.uniform(-max_turn, max_turn))
    (x, y), cos, sin = gravity, math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y
