"""Rectangular blocks of particles, thrown: what the methods' initial states have in common."""

from __future__ import annotations

from dataclasses import dataclass

from nmpm.sim.preset import require


@dataclass(frozen=True)
class Thrown:
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
        ConfigError: if a range is empty or out of reach.
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
            require(0 < low <= high, f"blocks.{key} = {[low, high]} needs two positive numbers, the lower first.")
        require(0 < self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        require(0 <= self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be at least 0 and below 0.5.")
        require(self.gap >= 0 and self.speed >= 0, "blocks.gap and blocks.speed must not be negative.")
