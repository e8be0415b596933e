"""Ranges from which the rectangular blocks of an initial state are drawn; the same keys for every solver."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

from nmpm.sim.config import check


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
