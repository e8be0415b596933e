"""Initial states: rectangular blocks of particles, thrown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.sim.materials.base import Array
from nmpm.sim.mpm_preset import MpmPreset

_ATTEMPTS = 10_000


@dataclass(frozen=True)
class Start:
    """N particles at the start, sorted by material.

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


def draw_start(preset: MpmPreset, rng: np.random.Generator) -> Start:
    """An initial state after the preset's `blocks`.

    Raises:
        ConfigError: if no arrangement of blocks is found, so crowded is the box.
    """
    # Drawn once: more blocks fit less often, and drawing anew would leave mostly single ones.
    number = int(rng.integers(preset.blocks.number[0], preset.blocks.number[1] + 1))
    for _ in range(_ATTEMPTS):
        lattices = _lattices(preset, number, rng)
        lows = _places(preset, lattices, rng)
        if lows is not None:
            break
    else:
        raise ConfigError(
            f"No room for {preset.blocks.particles} particles in blocks within {preset.box}: "
            "take fewer particles, a smaller spacing or a smaller gap."
        )
    speed, kinds = preset.blocks.speed, _kinds(number, len(preset.materials), rng)
    blocks = [
        _Block(low, lattice, rng.uniform(-speed, speed, preset.dim), kind)
        for low, lattice, kind in zip(lows, lattices, kinds, strict=True)
    ]
    return _filled(preset, sorted(blocks, key=lambda block: block.material), rng)


def _kinds(blocks: int, materials: int, rng: np.random.Generator) -> list[int]:
    """The material of each block: all of them in turn, in an order that is drawn."""
    rounds = [rng.permutation(materials) for _ in range(-(-blocks // materials))]
    return [int(kind) for kind in np.concatenate(rounds)[:blocks]]


def _lattices(preset: MpmPreset, number: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
    """Particles of each block along each axis, drawn until all together are as many as are asked for."""
    blocks = preset.blocks
    low, high = blocks.particles
    for _ in range(_ATTEMPTS):
        shares = blocks.share + (1 - number * blocks.share) * rng.dirichlet(np.ones(number))
        sizes = shares * rng.uniform(low, high)
        lattices = _sides(sizes, blocks.aspect, preset.dim, rng)
        if low <= int(lattices.prod(axis=1).sum()) <= high:
            return [tuple(map(int, lattice)) for lattice in lattices]
    raise ConfigError(f"No blocks have {blocks.particles} particles together: widen blocks.particles.")


def _sides(sizes: Array, aspect: tuple[float, float], dim: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(B, D) particles along each axis of blocks with about `sizes` (B,) particles: width, height and depth."""
    # Height over width, and in three dimensions depth over width after it.
    least, largest = np.log(aspect)
    ratios = [np.exp(rng.uniform(least, largest, len(sizes))) for _ in range(dim - 1)]
    width = np.maximum(1, np.rint((sizes / np.prod(ratios, axis=0)) ** (1 / dim)))
    depth = [np.maximum(1, np.rint(width * ratio)) for ratio in ratios[1:]]
    height = np.maximum(1, np.rint(sizes / np.prod([width, *depth], axis=0)))
    return np.stack([width, height, *depth], axis=1).astype(np.int64)


def _places(preset: MpmPreset, lattices: list[tuple[int, ...]], rng: np.random.Generator) -> list[Array] | None:
    """Lower corners of the blocks, or None if this draw lets two come too close."""
    gap = preset.blocks.gap
    box_low, box_high = np.array(preset.box).T
    placed: list[tuple[Array, Array]] = []
    for lattice in lattices:
        side = preset.spacing * np.array(lattice)
        first, last = box_low + gap, box_high - gap - side
        if preset.blocks.height is not None:
            lowest, highest = preset.blocks.height
            first[1], last[1] = max(first[1], box_low[1] + lowest), min(last[1], box_low[1] + highest)
        if np.any(last < first):
            return None
        low = rng.uniform(first, last)
        if any(np.all((low < other_high + gap) & (other_low < low + side + gap)) for other_low, other_high in placed):
            return None
        placed.append((low, low + side))
    return [low for low, _ in placed]


def _filled(preset: MpmPreset, blocks: list[_Block], rng: np.random.Generator) -> Start:
    positions, velocities = [], []
    counts = [0] * len(preset.materials)
    for block in blocks:
        axes = [np.arange(number) for number in block.lattice]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, preset.dim)
        shift = rng.uniform(-preset.blocks.jitter, preset.blocks.jitter, nodes.shape)
        positions.append(block.low + preset.spacing * (nodes + 0.5 + shift))
        velocities.append(np.broadcast_to(block.velocity, nodes.shape))
        counts[block.material] += len(nodes)
    extents = tuple((block.low, block.low + preset.spacing * np.array(block.lattice)) for block in blocks)
    return Start(np.concatenate(positions), np.concatenate(velocities), tuple(counts), extents)
