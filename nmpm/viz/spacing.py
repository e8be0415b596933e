"""The distance between neighbouring particles, which sets the size of the drawn discs."""

from __future__ import annotations

import math

import numpy as np

from nmpm.viz.trajectories import Floats

SAMPLES = 64
NEIGHBOURS = {2: 6, 3: 12}
"""Neighbours per dimension: enough to average over random placement, few enough to be local."""
UNIT_BALL_VOLUME = {2: math.pi, 3: 4 * math.pi / 3}


def particle_spacing(position: Floats) -> float:
    """Edge of the square or cube that one particle occupies, in domain length.

    A ball around a particle with the distance to its k-th neighbour as radius contains about k + 1/2 particles; the
    median radius over a sample of particles gives the spacing. The result is within 2% of the spacing of a regular
    lattice. For random positions it is the mean spacing, about twice the mean distance to the nearest neighbour.

    Args:
        position: (N, D), one frame; D is 2 or 3.

    Returns:
        The spacing; infinite for a single particle.
    """
    count, dim = position.shape
    neighbours = min(NEIGHBOURS[dim], count - 1)
    if neighbours == 0:
        return math.inf
    sample = position[np.linspace(0, count - 1, min(SAMPLES, count)).astype(int)].astype(np.float64)
    # One axis at a time, because the differences of all axes together exceed the cache.
    squares = np.zeros((len(sample), count))
    for axis in range(dim):
        squares += np.square(sample[:, axis, None] - position[None, :, axis])
    radius = np.sqrt(np.partition(squares, neighbours, axis=1)[:, neighbours])
    return float((UNIT_BALL_VOLUME[dim] * np.median(radius) ** dim / (neighbours + 0.5)) ** (1 / dim))
