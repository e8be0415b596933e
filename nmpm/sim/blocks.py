"""Initial states: rectangular blocks of particles, thrown."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nmpm.errors import ConfigError
from nmpm.sim.materials.base import Array
from nmpm.sim.mpm_preset import MpmPreset

_ATTEMPTS = 10_000


@dataclass(frozen=True)
class Start:
    """N particles at the start, sorted by material.

    Args:
        position: (N, 2) in length.
        velocity: (N, 2) in length per second.
        counts: Particles of each of the preset's materials.
    """

    position: Array
    velocity: Array
    counts: tuple[int, ...]


@dataclass(frozen=True)
class _Block:
    low: Array
    lattice: tuple[int, int]
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
    speed, kinds = preset.blocks.speed, len(preset.materials)
    blocks = [
        _Block(low, lattice, rng.uniform(-speed, speed, 2), int(rng.integers(kinds)))
        for low, lattice in zip(lows, lattices, strict=True)
    ]
    return _filled(preset, sorted(blocks, key=lambda block: block.material), rng)


def _lattices(preset: MpmPreset, number: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Columns and rows of each block, drawn until all together have a number of particles that is asked for."""
    blocks = preset.blocks
    low, high = blocks.particles
    for _ in range(_ATTEMPTS):
        shares = blocks.share + (1 - number * blocks.share) * rng.dirichlet(np.ones(number))
        sizes = shares * rng.uniform(low, high)
        aspects = np.exp(rng.uniform(math.log(blocks.aspect[0]), math.log(blocks.aspect[1]), number))
        columns = np.maximum(1, np.rint(np.sqrt(sizes / aspects))).astype(int)
        rows = np.maximum(1, np.rint(sizes / columns)).astype(int)
        if low <= int(columns @ rows) <= high:
            return [(int(c), int(r)) for c, r in zip(columns, rows, strict=True)]
    raise ConfigError(f"No blocks have {blocks.particles} particles together: widen blocks.particles.")


def _places(preset: MpmPreset, lattices: list[tuple[int, int]], rng: np.random.Generator) -> list[Array] | None:
    """Lower corners of the blocks, or None if this draw lets two come too close."""
    gap = preset.blocks.gap
    box_low, box_high = np.array(preset.box).T
    placed: list[tuple[Array, Array]] = []
    for lattice in lattices:
        side = preset.spacing * np.array(lattice)
        first, last = box_low + gap, box_high - gap - side
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
        columns, rows = block.lattice
        nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1).reshape(-1, 2)
        shift = rng.uniform(-preset.blocks.jitter, preset.blocks.jitter, nodes.shape)
        positions.append(block.low + preset.spacing * (nodes + 0.5 + shift))
        velocities.append(np.broadcast_to(block.velocity, nodes.shape))
        counts[block.material] += len(nodes)
    return Start(np.concatenate(positions), np.concatenate(velocities), tuple(counts))
