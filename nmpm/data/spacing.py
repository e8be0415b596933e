"""How far apart particles are, and the volume of one.

Nearest neighbours tell it on a lattice, and so do particles per volume. Material points at random places have much
nearer neighbours: of these only the latter tell it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nmpm.data.format import Metadata, Split
from nmpm.data.metadata import Fact
from nmpm.errors import DataError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from nmpm.data.samples import Sample

_QUERIES = 2000
_TRAJECTORIES = 8
_AROUND = 8  # neighbours that tell the density around a particle
_KEPT = 0.7  # of the median distance to the nearest particle, that 90% keep; at random it is 0.39 in a plane
_LATTICE = 0.05  # the two estimates differ by less on a lattice
_SETTLED = 3.0  # volume in first frames over that in last ones, if particles start loosely and settle
_NEIGHBOURS = 24
_POINTS = 4000
_CENTRED = 0.2  # of a ball's radius: mean offset of the particles in it, where it is full


def relative_positions(position: np.ndarray, metadata: Metadata) -> np.ndarray:
    """(N, D) float64 positions relative to the bounds, within the period on periodic axes."""
    lower, upper = np.asarray(metadata.bounds, dtype=np.float64).T
    wraps, relative = np.asarray(metadata.periodic), position.astype(np.float64) - lower
    return np.asarray(np.where(wraps, np.mod(relative, np.where(wraps, upper - lower, 1.0)), relative))


def neighbour_tree(position: np.ndarray, metadata: Metadata) -> cKDTree:
    """A search tree of (N, D) positions, relative to the bounds, that wraps on periodic axes."""
    from scipy.spatial import cKDTree  # takes 0.2 s, which loading a model need not wait for

    lower, upper = np.asarray(metadata.bounds, dtype=np.float64).T
    period = np.where(metadata.periodic, upper - lower, 0.0)  # cKDTree: 0 is not periodic
    return cKDTree(relative_positions(position, metadata), boxsize=period)


def _distances(tree: cKDTree, neighbour: int = 1, most: int = _QUERIES) -> np.ndarray:
    """(K,) distances of evenly chosen particles of a tree to the nearest other one, or to a further neighbour."""
    distances: np.ndarray = tree.query(tree.data[:: -(-tree.n // most)], k=[neighbour + 1])[0][:, 0]
    return distances


def neighbour_distance(split: Split, indices: Sequence[int], metadata: Metadata) -> float:
    """Median distance of moving particles to the nearest other one, in the first frames of some trajectories.

    At most 8 of them are read, evenly spaced; those that cannot be read are left out. Where particles are absent in the
    first frame, it is measured in the frame that has most. It is 0 where it is unknown.
    """
    distances = [np.empty(0)]
    for index in indices[:: -(-len(indices) // _TRAJECTORIES)]:
        try:
            moving = metadata.is_moving(split.particle_type(index))
            position = split.read(index, 0, 1).position[:, moving]
            if np.isnan(position).any():
                position = split.read(index).position[:, moving]
        except DataError:
            continue
        present = ~np.isnan(position[..., 0])
        fullest = int(present.sum(axis=1).argmax())
        if present[fullest].sum() > 1:
            tree = neighbour_tree(position[fullest, present[fullest]], metadata)
            distances.append(_distances(tree, most=tree.n))
    every = np.concatenate(distances)
    return float(np.median(every)) if len(every) else 0.0


def spacing_of(position: np.ndarray, metadata: Metadata) -> float:
    """The spacing of a lattice as dense as (N, D) positions around most particles; 0 for fewer than two."""
    there = position[~np.isnan(position[:, 0])]
    if len(there) < 2:
        return 0.0
    number, dim = min(_AROUND, len(there) - 1), there.shape[1]
    distance = float(np.median(_distances(neighbour_tree(there, metadata), number)))
    return distance * math.pow(_ball(dim) / number, 1 / dim)


def is_dense(position: np.ndarray, metadata: Metadata) -> bool:
    """Whether (N, D) particles keep their distance from one another, as in contact, and not as in flight."""
    there = position[~np.isnan(position[:, 0])]
    if len(there) < 2:
        return False
    low, middle = np.quantile(_distances(neighbour_tree(there, metadata)), (0.1, 0.5))
    return bool(low > _KEPT * middle)


def find_particle_volume(samples: Iterable[Sample], materials: frozenset[int]) -> Fact[float | None]:
    """The volume of a particle in length ** dim, from first frames, or from last ones where particles settle."""
    first, last = zip(*((sample.first.of(materials), sample.last.of(materials)) for sample in samples), strict=True)
    nearest, dense = _medians(_nearest_volume, first), _medians(_density_volume, first)
    nearest_late, dense_late = _medians(_nearest_volume, last), _medians(_density_volume, last)
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


def _nearest_volume(position: np.ndarray) -> float:
    """(Median distance of (N, D) particles to the nearest other one) ** dim; 0 where most coincide with another."""
    from scipy.spatial import cKDTree

    return math.pow(float(np.median(_distances(cKDTree(position), most=_POINTS))), position.shape[1])


def _density_volume(position: np.ndarray) -> float:
    """Volume per particle amid (N, D) particles: of balls with about 24 in them; 0 where there are too few.

    Balls around random points near particles count where they are full: where the particles in them are centred.
    """
    from scipy.spatial import cKDTree  # takes 0.2 s, which loading a model need not wait for

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
    return float(np.median(_ball(dim) * radius[full] ** dim)) / (_NEIGHBOURS - 1)


def mean_spacing(low: np.ndarray, high: np.ndarray) -> float:
    """Edge of a cube with an equal part of the box around paths, from their lower and upper ends (N, D)."""
    sides = high.max(axis=0) - low.min(axis=0)
    longest = float(sides.max()) or 1.0
    return longest * math.pow(float(np.prod(np.maximum(sides / longest, 1e-3))) / len(low), 1 / len(sides))


def _ball(dim: int) -> float:
    """Volume of a ball of radius 1."""
    return math.pow(math.pi, dim / 2) / math.gamma(dim / 2 + 1)
