"""The particles of the material point method while they move."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.sim.arrays import Array
from nmpm.sim.mpm.materials import Material


class MpmParticles:
    """N moving particles in D dimensions, sorted by material; a substep changes them in place.

    Args:
        position: (N, D) in length.
        velocity: (N, D) in length per second.
        groups: Material and number of particles of each group, in the particles' order.
        volume: Area of a particle at rest, or volume in three dimensions.
    """

    def __init__(
        self, position: NDArray[Any], velocity: NDArray[Any], groups: tuple[tuple[Material, int], ...], volume: float
    ) -> None:
        count, dim = position.shape
        self.position = np.array(position, dtype=np.float64, order="C")
        self.velocity = np.array(velocity, dtype=np.float64, order="C")
        self.gradient: Array = np.zeros((count, dim, dim))
        self.strain: Array = _unstrained(groups, dim)
        self.stress: Array = np.zeros((count, dim * (dim + 1) // 2))
        self.volume = volume
        self.mass: Array = np.repeat([m.density * volume for m, _ in groups], [n for _, n in groups])
        ends = np.cumsum([0] + [n for _, n in groups])
        self.parts = tuple((m, slice(a, b)) for (m, _), a, b in zip(groups, ends[:-1], ends[1:], strict=True))
        """Each material with the slice of its particles."""


def _unstrained(groups: tuple[tuple[Material, int], ...], dim: int) -> Array:
    """Strains at rest, as wide as the widest material's; the other materials do not use the last columns."""
    width = max(len(material.rest(dim)) for material, _ in groups)
    strain = np.zeros((sum(count for _, count in groups), width))
    first = 0
    for material, count in groups:
        rest = material.rest(dim)
        strain[first : first + count, : len(rest)] = rest
        first += count
    return strain
