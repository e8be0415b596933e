"""How far apart particles are, which decides how large they are drawn."""

from __future__ import annotations

import math

import numpy as np

from nmpm.viz.exhibit import Floats

SAMPLES = 64
NEIGHBOURS = {2: 6, 3: 12}
"""Neighbours counted, by dimension: enough to even out random placement, few enough to stay near the particle."""
UNIT_BALL = {2: math.pi, 3: 4 * math.pi / 3}


def particle_spacing(position: Floats) -> float:
    """The edge of the square or cube that one particle fills, in domain length.

    The ball that reaches to a particle's k-th neighbour holds about k + 1/2 particles; the median over some particles.
    For particles on a regular lattice this is the lattice's spacing within 2%, and for particles at random the mean
    one, where the distance to the nearest neighbour would be half of it.

    Args:
        position: (N, D) one frame, D is 2 or 3.

    Returns:
        The spacing; infinite for a single particle.
    """
    count, dim = position.shape
    neighbours = min(NEIGHBOURS[dim], count - 1)
    if neighbours == 0:
        return math.inf
    chosen = position[np.linspace(0, count - 1, min(SAMPLES, count)).astype(int)].astype(np.float64)
    # One axis at a time: the differences of all axes at once would not fit the cache.
    squares = np.zeros((len(chosen), count))
    for axis in range(dim):
        squares += np.square(chosen[:, axis, None] - position[None, :, axis])
    reach = np.sqrt(np.partition(squares, neighbours, axis=1)[:, neighbours])
    return float((UNIT_BALL[dim] * np.median(reach) ** dim / (neighbours + 0.5)) ** (1 / dim))
