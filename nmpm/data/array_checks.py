"""Checks of a trajectory's arrays: positions, types and fields."""

from __future__ import annotations

from typing import Any

import numpy as np

from nmpm.errors import DataError

CORE = ("position", "particle_type")
"""Names of the arrays that every trajectory has; all others are fields."""

_SWAPPED = 10.0
_SWAP = "np.swapaxes(position, 0, 1)"
_SAMPLE = 64  # frames and particles that are compared
_USUAL = 0.25  # quantile of the sizes of frames: some may have overflowed, or collapsed
_ABSURD = 1000.0  # times the usual size: no particle gets so far
_MANY = 0.1  # of the particles


def check_arrays(position: Any, particle_type: Any, where: str) -> None:
    """Raises a DataError for wrong dtypes or shapes of two arrays or HDF5 datasets."""
    wanted = {"position": ("f", 3, "floats of shape (T, N, D)"), "particle_type": ("iu", 1, "integers of shape (N,)")}
    for key, array in (("position", position), ("particle_type", particle_type)):
        kinds, axes, description = wanted[key]
        if array.dtype.kind not in kinds or array.ndim != axes or 0 in array.shape:
            raise DataError(f"{where}: {key} should be {description}; it is {array.dtype} of shape {array.shape}.")
    if position.shape[2] > 3:
        raise DataError(f"{where}: position has {position.shape[2]} dimensions; 1, 2 or 3 are possible.")
    if position.shape[1] != particle_type.shape[0]:
        swapped = position.shape[0] == particle_type.shape[0]
        mend = " Are its axes swapped? It should be (T, N, D), frames first: np.swapaxes(position, 0, 1)."
        raise DataError(
            f"{where}: position has {position.shape[1]} particles but particle_type has {particle_type.shape[0]}."
            f"{mend if swapped else ''}"
        )


def check_field(name: str, values: Any, where: str = "trajectory") -> None:
    """Raises a DataError if a field, an array or HDF5 dataset, does not contain numbers."""
    kind = getattr(getattr(values, "dtype", None), "kind", None)
    if name in CORE or not name or kind is None or kind not in "biufS":
        raise DataError(
            f"{where}: the field {name!r} must be an array of numbers; it is {getattr(values, 'dtype', type(values))}."
        )


def check_positions(position: np.ndarray, where: str, first_frame: int) -> None:
    """Raises a DataError for the first of (T, N, D) positions that is infinite, or NaN in some coordinates only."""
    finite = np.isfinite(position)
    if finite.all():
        return
    wrong = ~(finite.all(axis=-1) | np.isnan(position).all(axis=-1))
    if wrong.any():
        frame, particle = map(int, np.argwhere(wrong)[0])
        raise DataError(
            f"{where}: position of particle {particle} in frame {first_frame + frame} is"
            f" {position[frame, particle].tolist()}; positions must be finite, or NaN in all coordinates where the"
            " particle is absent. Remove the trajectory, or cut it before that frame."
        )


def check_end(position: np.ndarray, where: str) -> None:
    """Raises a DataError, naming the frame, if the particles of (T, N, D) positions vanish at once and for good.

    A particle that is absent from some frame on has left, or its simulation has diverged; of half of them or more in
    the same frame only the latter is likely.
    """
    if not np.isnan(position[-1, :, 0]).all():
        return
    count = position.shape[1] - np.isnan(position[..., 0]).sum(axis=1)
    if not count.any():
        raise DataError(f"{where}: no particle is there in any frame, all positions are NaN. Remove the trajectory.")
    frame = int(np.flatnonzero(count)[-1]) + 1
    if 2 * count[frame - 1] >= count.max():
        raise DataError(
            f"{where}: all positions are NaN from frame {frame} on; the simulation seems to have diverged. Cut the"
            f" trajectory before that frame: position[:{frame}]."
        )


def frames_at_one_point(position: np.ndarray) -> np.ndarray:
    """(T,) whether all particles that are there in a frame of (T, N, D) positions, two or more, are at one point."""
    low, high = np.fmin.reduce(position, axis=1), np.fmax.reduce(position, axis=1)
    return np.asarray((low == high).all(axis=1) & ((~np.isnan(position[..., 0])).sum(axis=1) > 1))


def particles_far_away(position: np.ndarray) -> np.ndarray:
    """(T, N) whether a particle is absurdly far from where all others are in most frames, as after an overflow."""
    low, high = np.fmin.reduce(position, axis=1), np.fmax.reduce(position, axis=1)
    with np.errstate(over="ignore"):
        sizes = (high - low).max(axis=1)
    known = np.isfinite(sizes) & (sizes > 0)
    if not known.any():
        return np.zeros(position.shape[:2], bool)
    usual = np.flatnonzero(known)[np.argsort(sizes[known], kind="stable")[int(_USUAL * (known.sum() - 1))]]
    reach = _ABSURD * float(sizes[usual])
    centre = (low[usual] + high[usual]) / 2
    if np.abs(np.stack([low - centre, high - centre])[:, known]).max() <= reach:
        return np.zeros(position.shape[:2], bool)
    return np.asarray((np.abs(position - centre) > reach).any(axis=2))


def broken_frames(position: np.ndarray) -> np.ndarray:
    """(T,) whether a frame of (T, N, D) positions is no data: all particles at one point, or many far away."""
    far: np.ndarray = particles_far_away(position).mean(axis=1) > _MANY
    broken: np.ndarray = frames_at_one_point(position) | far
    return broken


def check_axes(position: np.ndarray, particles: int | None, where: str) -> None:
    """Refuses (N, T, D) positions where the number of particles is known and tells the axes apart.

    Raises:
        DataError: naming `where`, and how to swap the axes.
    """
    if particles == position.shape[0] != position.shape[1]:
        raise DataError(
            f"{where}: the axes of positions {position.shape} look swapped: there are {particles} particles. Give (T,"
            f" N, D), frames first: {_SWAP}."
        )


def swapped_axes(position: np.ndarray) -> str:
    """Why positions look as (N, T, D) rather than (T, N, D), and the remedies; empty if they do not.

    Between frames a particle moves less than the distance to another particle, which may be anywhere; the limit is
    `_SWAPPED` times that distance. Particles on a lattice that are fast, or rarely recorded, look swapped, too.
    """
    sample = position[:_SAMPLE, :_SAMPLE].astype(np.float64)
    if min(sample.shape[:2]) < 2:
        return ""
    first, second = (_median_distance(sample, axis) for axis in (0, 1))
    if not first > _SWAPPED * second > 0:
        return ""
    return (
        f"the axes of positions look swapped: neighbours along the first of {position.shape} are {first:.3g} apart,"
        f" along the second {second:.3g}. Give (T, N, D), frames first: {_SWAP}. Or state that they are so: --axes TND."
    )


def _median_distance(sample: np.ndarray, axis: int) -> float:
    """Median distance between neighbours along an axis, of those that are present; 0 if none are."""
    distances = np.linalg.norm(np.diff(sample, axis=axis), axis=-1)
    finite = distances[np.isfinite(distances)]
    return float(np.median(finite)) if finite.size else 0.0
