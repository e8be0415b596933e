"""Volumes of particles of different size, from a field that says how large they are, or an attribute of all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.hdf5 import check_stored_size, open_hdf5
from nmpm.data.metadata import Fact
from nmpm.errors import DataError

if TYPE_CHECKING:
    from nmpm.data.facts import Sample


SIZES = ("volume", "radius", "diameter", "size")
"""Names of fields that say how large particles are; the first that a trajectory has counts."""
VOLUME = "particle_volume"
"""Attribute of a trajectory whose particles have a volume of their own, other than the dataset's."""
_VARIES = 1.01  # largest over smallest volume; below that, all particles are alike
_CONSTANT = 1e-5  # of a value; it may change by that in time
_SAMPLE = 8  # trajectories


def mean_volume(split: Split, metadata: Metadata) -> float | None:
    """Mean volume of the moving particles of a dataset, in units that cancel in ratios; None where all are alike.

    The volume is the field `volume`, or the power `dim` of `radius`, `diameter` or `size`, where it is constant in
    time. Up to 8 trajectories are read.
    """
    every = [
        values[metadata.is_moving(split.particle_type(index))]
        for index in range(0, len(split), -(-len(split) // _SAMPLE))
        if (values := volumes(split, index, metadata)) is not None
    ]
    sample = np.concatenate([np.empty(0), *every])
    sample = sample[sample > 0]
    return float(sample.mean()) if len(sample) and sample.max() > _VARIES * sample.min() else None


def volumes(split: Split, index: int, metadata: Metadata) -> np.ndarray | None:
    """(N,) volumes of a trajectory's particles, as in `mean_volume`; None where no field gives them."""
    particles = split.particles(index)
    with open_hdf5(split.path) as file:
        group = file[split.names[index]]
        for name in SIZES:
            stored = group.get(name)
            if isinstance(stored, h5py.Dataset) and stored.ndim <= 2 and stored.shape[-1:] == (particles,):
                check_stored_size(stored, f"{split.where(index)}: {name}")
                return _volumes_of(name, stored, metadata.dim)
    return None


def stated_volumes(trajectory: Trajectory, particle_volume: float | None, where: str) -> np.ndarray | None:
    """(N,) volumes of a trajectory's particles by its attribute `particle_volume`, as multiples of the dataset's.

    None where the attribute is missing or the dataset's volume is not known.

    Raises:
        DataError: naming `where`, if the attribute is not a positive number.
    """
    stated = trajectory.attributes.get(VOLUME)
    if stated is None or particle_volume is None:
        return None
    values = np.asarray(stated)
    if values.shape not in ((), (1,)) or values.dtype.kind not in "iuf" or not 0 < values.item() < np.inf:
        raise DataError(
            f"{where}: the attribute particle_volume = {one_line(stated, 60)} should be a positive number, the volume"
            " of each particle in length ** dim."
        )
    return np.full(len(trajectory.particle_type), values.item() / particle_volume)


def relative_volumes(trajectory: Trajectory, moving: np.ndarray) -> np.ndarray | None:
    """(N',) volumes of the (N,) `moving` particles over their mean; None where all are alike or no field has them.

    Where the trajectory states its own volume, they are over the dataset's.
    """
    dataset = trajectory.metadata.particle_volume if trajectory.metadata is not None else None
    stated = stated_volumes(trajectory, dataset, "the trajectory")
    if stated is not None:
        return np.asarray(stated[moving])
    frames, particles, dim = trajectory.position.shape
    sizes = {name: values for name, values in trajectory.fields.items() if name in SIZES}
    fitting = [name for name in SIZES if name in sizes and sizes[name].shape in ((particles,), (frames, particles))]
    values = _volumes_of(fitting[0], sizes[fitting[0]], dim) if fitting else None
    if values is None or not (values[moving] > 0).all():
        return None
    values = values[moving]
    return values / values.mean() if values.max() > _VARIES * values.min() else None


def _volumes_of(name: str, stored: Any, dim: int) -> np.ndarray | None:
    """(N,) volumes, NaN where a size is not positive; None if sizes are no numbers or change in time."""
    if stored.dtype.kind not in "iuf":
        return None
    values = np.atleast_2d(np.asarray(stored[()], dtype=np.float64))
    low, high = np.fmin.reduce(values, axis=0), np.fmax.reduce(values, axis=0)
    if (high - low > _CONSTANT * np.abs(high)).any():
        return None
    return np.where(low > 0, low, np.nan) ** (1 if name == "volume" else dim)


def check_positive(volume: np.ndarray, moving: np.ndarray, where: str) -> np.ndarray:
    """The (N',) float32 volumes of the moving particles, of (N,) ones; a DataError if one is not positive."""
    wrong = moving & ~((volume > 0) & np.isfinite(volume))
    if wrong.any():
        raise DataError(
            f"{where}: the size of particle {int(np.argmax(wrong))} ({' or '.join(SIZES)}) is not a positive"
            " number. Correct the field, or rename it if it is no size."
        )
    return np.asarray(volume[moving], dtype=np.float32)


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
    from scipy.spatial import cKDTree  # takes 0.2 s, which loading a model need not wait for

    some = position[:: -(-len(position) // _POINTS)]
    distance = cKDTree(position).query(some, k=2)[0][:, 1]
    return float(np.median(distance) ** position.shape[1])


def density_volume(position: np.ndarray) -> float:
    """Volume per particle amid (N, D) particles: of balls with about 24 in them; 0 where there are too few.

    Balls around random points near particles count where they are full: where the particles in them are centred.
    """
    from scipy.spatial import cKDTree

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
