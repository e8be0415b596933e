"""Initial states of the material point method: rectangular blocks of particles, each with one velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.blocks import BlockRanges, lattice
from nmpm.sim.config import check
from nmpm.sim.state import Array

_ATTEMPTS = 10_000


@dataclass(frozen=True)
class DrawnBlocks:
    """N particles in blocks, sorted by material.

    Args:
        position: (N, D) in length.
        velocity: (N, D) in length per second.
        counts: Particles of each of the preset's materials.
        extents: Lower and upper corner of each block, (D,) each.
    """

    position: Array
    velocity: Array
    counts: tuple[int, ...]
    extents: tuple[tuple[Array, Array], ...]


@dataclass(frozen=True)
class _Block:
    low: Array
    lattice: tuple[int, ...]
    velocity: Array
    material: int


@dataclass(frozen=True)
class MpmBlockRanges(BlockRanges):
    """How blocks are drawn: `BlockRanges`, and their height in the box.

    Args:
        height: Least and largest height of a block above the box's bottom, as far as the gap allows; anywhere if None.

    Raises:
        ConfigError: if a range is empty or a value is out of range.
    """

    height: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.height or (0.0, 0.0)
        check(0 <= low <= high, f"blocks.height = {self.height} needs two numbers, the lower first.")

    def draw(self, box: tuple[Interval, ...], spacing: float, materials: int, rng: np.random.Generator) -> DrawnBlocks:
        """Random blocks within a box.

        Args:
            box: (lower, upper) along each axis, in length.
            spacing: Between the particles of a block, in length.
            materials: How many there are; blocks take them in turn.
            rng: To draw with.

        Raises:
            ConfigError: if no arrangement of blocks fits into the box.
        """
        # Drawn once: more blocks fit less often, and drawing anew would leave mostly single ones.
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_ATTEMPTS):
            lattices = self._draw_lattices(number, len(box), rng)
            lows = self._place(box, spacing, lattices, rng)
            if lows is not None:
                break
        else:
            raise ConfigError(
                f"No room for {self.particles} particles in blocks within {box}: "
                "take fewer particles, a smaller spacing or a smaller gap."
            )
        kinds = _draw_materials(number, materials, rng)
        blocks = [
            _Block(low, shape, rng.uniform(-self.speed, self.speed, len(box)), kind)
            for low, shape, kind in zip(lows, lattices, kinds, strict=True)
        ]
        return self._fill(sorted(blocks, key=lambda block: block.material), spacing, materials, rng)

    def _draw_lattices(self, number: int, dim: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
        """Particles of each block along each axis, drawn until their sum is within `particles`."""
        low, high = self.particles
        for _ in range(_ATTEMPTS):
            shares = self.share + (1 - number * self.share) * rng.dirichlet(np.ones(number))
            sizes = shares * rng.uniform(low, high)
            lattices = _block_sides(sizes, self.aspect, dim, rng)
            if low <= int(lattices.prod(axis=1).sum()) <= high:
                return [tuple(map(int, shape)) for shape in lattices]
        raise ConfigError(f"No blocks have {self.particles} particles together: widen blocks.particles.")

    def _place(
        self,
        box: tuple[Interval, ...],
        spacing: float,
        lattices: list[tuple[int, ...]],
        rng: np.random.Generator,
    ) -> list[Array] | None:
        """Lower corners of the blocks, or None if one does not fit or two come too close."""
        gap = self.gap
        box_low, box_high = np.array(box).T
        placed: list[tuple[Array, Array]] = []
        for shape in lattices:
            side = spacing * np.array(shape)
            first, last = box_low + gap, box_high - gap - side
            if self.height is not None:
                lowest, highest = self.height
                first[1], last[1] = max(first[1], box_low[1] + lowest), min(last[1], box_low[1] + highest)
            if np.any(last < first):
                return None
            low = rng.uniform(first, last)
            if any(
                np.all((low < other_high + gap) & (other_low < low + side + gap)) for other_low, other_high in placed
            ):
                return None
            placed.append((low, low + side))
        return [low for low, _ in placed]

    def _fill(self, blocks: list[_Block], spacing: float, materials: int, rng: np.random.Generator) -> DrawnBlocks:
        """The particles of placed blocks, which are sorted by material."""
        positions, velocities = [], []
        counts = [0] * materials
        for block in blocks:
            shift = rng.uniform(-self.jitter, self.jitter, (math.prod(block.lattice), len(block.lattice)))
            positions.append(lattice(block.low, block.lattice, spacing, shift))
            velocities.append(np.broadcast_to(block.velocity, shift.shape))
            counts[block.material] += len(shift)
        extents = tuple((block.low, block.low + spacing * np.array(block.lattice)) for block in blocks)
        return DrawnBlocks(np.concatenate(positions), np.concatenate(velocities), tuple(counts), extents)


def _draw_materials(blocks: int, materials: int, rng: np.random.Generator) -> list[int]:
    """The material of each block: all of them in turn, in random order."""
    rounds = [rng.permutation(materials) for _ in range(-(-blocks // materials))]
    return [int(kind) for kind in np.concatenate(rounds)[:blocks]]


def _block_sides(sizes: Array, aspect: tuple[float, float], dim: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(B, D) particles along each axis of blocks with about `sizes` (B,) particles: width, height and depth."""
    # Height over width, and in three dimensions depth over width after it.
    least, largest = np.log(aspect)
    ratios = [np.exp(rng.uniform(least, largest, len(sizes))) for _ in range(dim - 1)]
    width = np.maximum(1, np.rint((sizes / np.prod(ratios, axis=0)) ** (1 / dim)))
    depth = [np.maximum(1, np.rint(width * ratio)) for ratio in ratios[1:]]
    height = np.maximum(1, np.rint(sizes / np.prod([width, *depth], axis=0)))
    return np.stack([width, height, *depth], axis=1).astype(np.int64)
