"""Initial states: the layout of moving material, and ranges from which rectangular blocks of it are drawn."""

from __future__ import annotations

import abc
import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np

from nmpm.sim.state import Array, check, check_numbers


class Layout(abc.ABC):
    """How the initial state is drawn."""

    @abc.abstractmethod
    def faster(self, factor: float) -> Self:
        """The same at initial speeds times a factor."""

    @abc.abstractmethod
    def multiplied(self, times: int) -> Self:
        """For a box so many times as wide: up to as many times as many particles."""


@dataclass(frozen=True)
class BlockRanges(Layout):
    """How blocks are drawn; lengths in metres.

    Args:
        number: Least and most blocks in a scene.
        particles: Least and most particles in a scene, all blocks together.
        share: Least part of the particles in one block.
        aspect: Least and largest height over width.
        gap: Least distance between blocks, and from the box's sides.
        speed: Largest initial velocity along each axis, in length per second.
        jitter: Largest displacement of a particle off the lattice along each axis, in spacings.
    """

    number: tuple[int, int]
    particles: tuple[int, int]
    share: float
    aspect: tuple[float, float]
    gap: float
    speed: float
    jitter: float

    def __post_init__(self) -> None:
        check_numbers(
            self, "blocks.", positive=("number", "particles", "share", "aspect"), at_least_0=("gap", "speed", "jitter")
        )
        check(self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        check(self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be below 0.5.")

    def faster(self, factor: float) -> Self:
        return dataclasses.replace(self, speed=factor * self.speed)

    def multiplied(self, times: int) -> Self:
        return dataclasses.replace(
            self,
            particles=(self.particles[0], times * self.particles[1]),
            number=(self.number[0], times * self.number[1]),
            share=self.share / times,
        )


def lattice(low: Array, shape: tuple[int, ...], spacing: float, shift: Array | float = 0.0) -> Array:
    """(N, D) centres of the cells of a lattice, moved by `shift` (N, D) spacings; the last axis varies fastest."""
    nodes = np.stack(np.meshgrid(*(np.arange(number) for number in shape), indexing="ij"), axis=-1)
    return np.asarray(low + spacing * (nodes.reshape(-1, len(shape)) + 0.5 + shift))
