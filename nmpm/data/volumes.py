"""Volumes of particles of different size, from a field that says how large they are, or an attribute of all of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.errors import DataError

SIZES = ("volume", "radius", "diameter", "size")
"""Names of fields that say how large particles are; the first that a trajectory has counts."""
VOLUME = "particle_volume"
"""Attribute of a trajectory whose particles have a volume of their own, other than the dataset's."""
_VARIES = 1.01  # largest over smallest volume; below that, all particles are alike
_CONSTANT = 1e-5  # of a value; it may change by that in time
_SAMPLE = 8  # trajectories


def mean_volume(split: Split, metadata: Metadata) -> float | None:
    """Mean of the `split_volumes` of moving particles, in up to 8 trajectories; None where all are alike."""
    every = [
        values[metadata.is_moving(split.particle_type(index))]
        for index in split.spread(_SAMPLE)
        if (values := split_volumes(split, index)) is not None
    ]
    sample = np.concatenate([np.empty(0), *every])
    sample = sample[sample > 0]
    return float(sample.mean()) if len(sample) and sample.max() > _VARIES * sample.min() else None


def split_volumes(split: Split, index: int) -> np.ndarray | None:
    """(N,) volumes of the particles of a split's trajectory, see `volumes_by_size`."""
    return volumes_by_size(split.stored(index, SIZES), (split.frames(index), split.particles(index)), split.dim)


def volumes_by_size(fields: Mapping[str, np.ndarray], sizes: tuple[int, int], dim: int) -> np.ndarray | None:
    """(N,) volumes of particles in units that cancel in ratios; NaN where a size is not positive.

    The volume is the field `volume`, or the power `dim` of `radius`, `diameter` or `size`; the first that is there
    counts. None where there is none, (T, N) or (N,) numbers, or it changes in time.
    """
    name = next((name for name in SIZES if name in fields and fields[name].shape in (sizes, sizes[1:])), None)
    if name is None or fields[name].dtype.kind not in "iuf":
        return None
    values = np.atleast_2d(fields[name].astype(np.float64))
    low, high = np.fmin.reduce(values, axis=0), np.fmax.reduce(values, axis=0)
    if (high - low > _CONSTANT * np.abs(high)).any():
        return None
    return np.where(low > 0, low, np.nan) ** (1 if name == "volume" else dim)


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
    values = volumes_by_size(trajectory.fields, (frames, particles), dim)
    if values is None or not (values[moving] > 0).all():
        return None
    values = values[moving]
    return values / values.mean() if values.max() > _VARIES * values.min() else None


def check_positive(volume: np.ndarray, moving: np.ndarray, where: str) -> np.ndarray:
    """The (N',) float32 volumes of the moving particles, of (N,) ones; a DataError if one is not positive."""
    wrong = moving & ~((volume > 0) & np.isfinite(volume))
    if wrong.any():
        raise DataError(
            f"{where}: the size of particle {int(np.argmax(wrong))} ({' or '.join(SIZES)}) is not a positive"
            " number. Correct the field, or rename it if it is no size."
        )
    return np.asarray(volume[moving], dtype=np.float32)
