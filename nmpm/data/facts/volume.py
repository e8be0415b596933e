"""The volume of a particle, from the distances and the number density of particles.

On a lattice it is (distance to the nearest neighbour) ** dim. Of particles at random places the nearest neighbour is
far closer than the spacing, so their number is counted in balls around random points amid them: ball / count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from nmpm.data.facts.fact import Fact
from nmpm.data.facts.sample import Sample

_LATTICE = 0.05  # the two estimates differ by less on a lattice
_SETTLED = 3.0  # volume in first frames over that in last ones, if particles start loosely and settle
_NEIGHBOURS = 24
_POINTS = 4000
_CENTRED = 0.2  # of a ball's radius: mean offset of the particles in it, where it is full


def find_particle_volume(samples: Iterable[Sample], materials: frozenset[int]) -> Fact[float | None]:
    """The volume of a particle in length ** dim, from first frames, or from last ones where particles settle."""
    first, last = zip(*((sample.first.of(materials), sample.last.of(materials)) for sample in samples), strict=True)
    nearest, dense = _medians(nearest_volume, first), _medians(density_volume, first)
    nearest_late, dense_late = _medians(nearest_volume, last), _medians(density_volume, last)
    if not nearest:
        return Fact(None, "no two particles are there in a first frame.", "guessed")
    if not dense:
        return Fact(nearest, "as on a lattice, by the distance of nearest neighbours in first frames.", "likely")
    how = "in first frames, by"
    if dense_late and dense > _SETTLED * dense_late:
        how = (
            f"particles are {dense / dense_late:.1f} times denser in last frames than in first ones, where each has a"
            f" volume of {dense:.3g}; this is the volume in last frames, by"
        )
        nearest, dense = nearest_late, dense_late
    if abs(nearest / dense - 1) < _LATTICE:
        how = f"{how} the distance of nearest neighbours; particles per volume give {dense:.4g}."
        return Fact(nearest, how, "measured")
    how = f"{how} particles per volume; nearest neighbours on a lattice would give {nearest:.4g}."
    return Fact(dense, how, "likely")


def _medians(estimate: Callable[[np.ndarray], float], clouds: Sequence[np.ndarray]) -> float:
    values = [estimate(cloud) for cloud in clouds if len(cloud) > 1]
    values = [value for value in values if value > 0]
    return float(np.median(values)) if values else 0.0


def nearest_volume(position: np.ndarray) -> float:
    """(Median distance of (N, D) particles to the nearest other one) ** dim; 0 where most coincide with another."""
    some = position[:: -(-len(position) // _POINTS)]
    distance = cKDTree(position).query(some, k=2)[0][:, 1]
    return float(np.median(distance) ** position.shape[1])


def density_volume(position: np.ndarray) -> float:
    """Volume per particle amid (N, D) particles: of balls with about 24 in them; 0 where there are too few.

    Balls around random points near particles count where they are full: where the particles in them are centred.
    """
    count, dim = position.shape
    if count < 2 * _NEIGHBOURS:
        return 0.0
    rng, tree = np.random.default_rng(0), cKDTree(position)
    centres = position[rng.integers(count, size=_POINTS)]
    spread = tree.query(centres, k=4)[0][:, -1:]
    centres = centres + rng.uniform(-0.5, 0.5, centres.shape) * spread
    distance, index = tree.query(centres, k=_NEIGHBOURS)
    # Half-way between the last two, so that lattices' shells are not preferred.
    radius = distance[:, -2:].mean(axis=1)
    offset = np.linalg.norm(position[index[:, :-1]].mean(axis=1) - centres, axis=1)
    full = (offset < _CENTRED * radius) & (radius > 0)
    if full.sum() < _POINTS // 100:
        return 0.0
    ball = math.pi ** (dim / 2) / math.gamma(dim / 2 + 1) * radius[full] ** dim
    return float(np.median(ball)) / (_NEIGHBOURS - 1)
