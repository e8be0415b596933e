"""Statistics of trajectories: extents, displacements, what moves, and what contradicts the metadata.

Positions of absent particles are NaN and count nowhere; the displacement to or from them is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.scene import Boundary, Interval, Scene

STATISTICS_KEYS = ("vel_mean", "vel_std", "acc_mean", "acc_std")
FINE_STEPS = 1000.0
"""Float32 numbers between neighbouring particles that are enough."""
AT_REST = 1e-4
"""Spacings: particles whose paths are shorter never move."""
_FAR = 0.5  # spacings: half of the particles move further where a trajectory moves
_LOST = 1e-3  # of the extent: shorter displacements of walls are lost on a grid


class Extent:
    """Smallest and largest coordinates (D,) of the positions added so far; infinite before the first."""

    def __init__(self, dim: int) -> None:
        self.lower, self.upper = np.full(dim, np.inf), np.full(dim, -np.inf)
        self.gone = 0  # particles that leave the bounds of an open axis, where somebody has counted them

    def add(self, position: np.ndarray) -> None:
        """Adds (T, N, D) positions, or none."""
        if position.size:
            self.lower = np.fmin(self.lower, np.fmin.reduce(position, axis=(0, 1)))
            self.upper = np.fmax(self.upper, np.fmax.reduce(position, axis=(0, 1)))

    @property
    def intervals(self) -> tuple[Interval, ...]:
        """(lower, upper) per axis."""
        return tuple(zip(self.lower.tolist(), self.upper.tolist(), strict=True))

    def notes(self, metadata: Metadata) -> list[str]:
        """Sentences on positions beyond the stated bounds."""
        beyond = [
            f"Along {'xyz'[axis]} positions reach from {low:.4g} to {high:.4g}, beyond the stated bounds"
            f" {list(bounds)}; the scene's domain contains them."
            for axis, ((low, high), bounds) in enumerate(zip(self.intervals, metadata.bounds, strict=True))
            if metadata.boundary[axis] == "wall" and (low < bounds[0] or high > bounds[1])
        ]
        gone = f"{self.gone} particles leave the bounds of an open axis; they count as absent from then on."
        return [*beyond, gone] if self.gone else beyond


def too_coarse(spacing: float, rounding: float, lower: Iterable[float]) -> Iterator[str]:
    """Yields a sentence if float32 resolves coordinates too coarsely for particles of this spacing.

    Args:
        spacing: Distance of neighbours; infinite where it is unknown.
        rounding: Distance of float32 numbers where coordinates are largest.
        lower: The corner (D,) to subtract.
    """
    if spacing < FINE_STEPS * rounding:
        places = max(0, math.ceil(-math.log10(spacing)) - 1) if spacing else 0  # the rest is about ten spacings
        corner = ", ".join(f"{low:.{places}f}" for low in lower)
        yield (
            f"coordinates are so far from the origin that float32 has only {spacing / rounding:.3g} steps between"
            f" neighbours ({FINE_STEPS:g} are enough). Subtract about ({corner}) from positions and bounds, in float64."
        )


def notes_on_rounding(metadata: Metadata) -> list[str]:
    """A sentence if the bounds are too far from the origin for float32; none where the particles' volume is unknown."""
    if metadata.particle_volume is None:
        return []
    spacing, corner = float(metadata.particle_volume ** (1 / metadata.dim)), [low for low, _ in metadata.bounds]
    return [f"float32: {sentence}" for sentence in too_coarse(spacing, float32_rounding(metadata.bounds), corner)]


def float32_rounding(box: Sequence[Interval]) -> float:
    """Largest distance of neighbouring float32 numbers in a box (D,)."""
    return float(np.spacing(np.float32(np.abs(box).max())))


def evenly(count: int, most: int) -> list[int]:
    """Indices of items from the first to the last of so many, evenly spaced."""
    indices: list[int] = np.unique(np.linspace(0, count - 1, most).astype(int)).tolist()
    return indices


def extent_of(position: np.ndarray) -> Extent:
    """The extent of (T, N, D) positions."""
    extent = Extent(position.shape[2])
    extent.add(position)
    return extent


def notes_on_lengths(frames: set[int], metadata: Metadata, others: Iterable[int] = ()) -> list[str]:
    """A sentence if trajectories have other numbers of frames than the metadata's `sequence_length` or `others`."""
    # Files often have one frame more than stated.
    expected = {length + more for length in (metadata.sequence_length, *others) for more in (0, 1)}
    few, many = min(frames), max(frames)
    if frames <= expected:
        return []
    lengths = f"{few}" if few == many else f"{few} to {many}"
    return [f"The metadata state sequence_length {metadata.sequence_length}; trajectories have {lengths} frames."]


def displacements(position: np.ndarray, metadata: Metadata) -> np.ndarray:
    """(T - 1, N, D) float64 displacements between successive frames, by minimum image on periodic axes."""
    lower, upper = np.asarray(metadata.bounds).T
    step: np.ndarray = np.diff(position.astype(np.float64), axis=0)
    for axis in np.flatnonzero(metadata.periodic):
        period = upper[axis] - lower[axis]
        step[..., axis] -= period * np.round(step[..., axis] / period)
    return step


def lengths(vectors: np.ndarray) -> np.ndarray:
    """(…) lengths of (…, D) vectors."""
    return np.asarray(np.sqrt(np.einsum("...d,...d->...", vectors, vectors)))


class MotionStatistics:
    """Accumulates the moments of the moving particles' velocities and accelerations over trajectories.

    Velocities are differences of successive frames, in length per frame; accelerations are differences of velocities,
    in length per frame squared.
    """

    def __init__(self, metadata: Metadata) -> None:
        self._metadata = metadata
        # Count, sum and sum of squares, per axis.
        self._sums = {"vel": np.zeros((3, metadata.dim)), "acc": np.zeros((3, metadata.dim))}

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        self.add_moments(self.moments(trajectory))

    def add_moments(self, moments: Mapping[str, np.ndarray]) -> None:
        """Adds the moments of a trajectory."""
        for key, values in moments.items():
            self._sums[key] += values

    def moments(self, trajectory: Trajectory) -> dict[str, np.ndarray]:
        """(3, D) count, sum and sum of squares of a trajectory's velocities and accelerations."""
        moving = self._metadata.is_moving(trajectory.particle_type)
        position = trajectory.position if moving.all() else trajectory.position[:, moving]
        velocity, moments = displacements(position, self._metadata), {}
        for key, values in (("vel", velocity), ("acc", np.diff(velocity, axis=0))):
            moments[key] = np.empty((3, values.shape[-1]))
            for axis, along in enumerate(np.moveaxis(values, -1, 0)):
                flat = along.ravel()  # next to each other, sums are several times as fast
                if np.isnan(total := flat.sum()):
                    flat = flat[~np.isnan(flat)]
                    total = flat.sum()
                moments[key][:, axis] = len(flat), total, np.square(flat).sum()
        return moments

    def result(self) -> dict[str, list[float]]:
        """`vel_mean`, `vel_std`, `acc_mean` and `acc_std` per axis; those without any sample are left out."""
        statistics = {}
        for key, (count, total, squares) in self._sums.items():
            if count.all():
                mean = total / count
                statistics[f"{key}_mean"] = mean.tolist()
                statistics[f"{key}_std"] = np.sqrt(np.maximum(0.0, squares / count - mean**2)).tolist()
        return statistics


def find_disagreements(measured: Mapping[str, list[float]], stated: Mapping[str, Any]) -> list[str]:
    """A sentence for each stated standard deviation that differs by more than 10% from the measured one."""
    sentences = []
    for key in ("vel_std", "acc_std"):
        try:
            expected = np.asarray(stated[key], dtype=np.float64)
            actual = np.asarray(measured[key])
        except (KeyError, TypeError, ValueError):
            continue
        if expected.shape != actual.shape or not np.allclose(expected, actual, rtol=0.1, atol=0):
            shown = f"{_short(expected)}; these trajectories have {_short(actual)}"
            sentences.append(f"The metadata state {key} = {shown}.")
    return sentences


def _short(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.atleast_1d(values)) + ")"


def are_outside(position: np.ndarray, domain: Sequence[Interval], boundary: Sequence[Boundary]) -> np.ndarray:
    """Whether positions (..., D) are beyond walls, (...) bool."""
    lower, upper = np.asarray(domain, dtype=np.float32).T
    outside: np.ndarray = (((position < lower) | (position > upper)) & [kind == "wall" for kind in boundary]).any(-1)
    return outside


def first_outside(
    position: np.ndarray, domain: Sequence[Interval], boundary: Sequence[Boundary], counted: np.ndarray | bool = True
) -> tuple[int, int, int] | None:
    """Frame and particle of the first (T, N, D) position outside, and how many particles are ever; None if none is.

    Outside are positions beyond walls. Only particles that are `counted`, (N,), are compared.
    """
    ends = zip(np.asarray(domain, dtype=np.float32), boundary, strict=True)
    if position.size > 0 and all(
        kind != "wall" or bool(position[..., axis].min() >= low and position[..., axis].max() <= high)
        for axis, ((low, high), kind) in enumerate(ends)
    ):  # the usual case, and quicker than the following
        return None
    outside = are_outside(position, domain, boundary) & counted
    if not outside.any():
        return None
    frame, particle = map(int, np.argwhere(outside)[0])
    return frame, particle, int(outside.any(axis=0).sum())


def path_extents(position: np.ndarray) -> np.ndarray:
    """(N,) extents of the paths of particles (T, N, D) along their longest axis; NaN if one is there only once."""
    low, high = np.fmin.reduce(position, axis=0), np.fmax.reduce(position, axis=0)
    reach = (high - low).max(axis=1).astype(np.float64)
    reach[np.isfinite(position[..., 0]).sum(axis=0) < 2] = np.nan
    return np.asarray(reach)


def never_moving(position: np.ndarray, spacing: float) -> np.ndarray:
    """(N,) whether particles (T, N, D) never move, while most of those that do go far."""
    reach = path_extents(position)
    movers = reach[reach > AT_REST * spacing]
    far = len(movers) > 0 and float(np.median(movers)) > _FAR * spacing
    return np.asarray((reach < AT_REST * spacing) & far)


def first_moving_particle(position: np.ndarray, particles: np.ndarray, extent: Sequence[Interval]) -> int | None:
    """Index of the first of some (N,) particles that moves by over a thousandth of the extent (D,), or None."""
    if not particles.any():
        return None
    lower, upper = np.asarray(extent).T
    candidates = position[:, particles]
    first = candidates[np.argmax(~np.isnan(candidates[..., 0]), axis=0), np.arange(candidates.shape[1])]
    moves = (np.abs(candidates - first) > _LOST * (upper - lower)).any(axis=(0, 2))
    return int(np.flatnonzero(particles)[int(np.argmax(moves))]) if moves.any() else None


def without_those_gone(position: np.ndarray, facts: Scene | Metadata) -> np.ndarray:
    """(T, N, D) positions, NaN from the frame on in which a particle is beyond the bounds of an open axis."""
    open_axes = [kind == "open" for kind in facts.boundary]
    if not any(open_axes):
        return position
    lower, upper = np.asarray(facts.bounds, dtype=np.float32).T
    outside = (((position < lower) | (position > upper)) & open_axes).any(axis=-1)
    gone = np.logical_or.accumulate(outside, axis=0)
    return np.where(gone[..., None], np.float32(np.nan), position)


def count_gone(position: np.ndarray, metadata: Metadata) -> int:
    """Number of particles of which `without_those_gone` leaves positions out."""
    kept = without_those_gone(position, metadata)
    return 0 if kept is position else int((np.isnan(kept[..., 0]) > np.isnan(position[..., 0])).any(axis=0).sum())


def roundest(low: float, high: float) -> float:
    """The number in [low, high] with the fewest digits; of equally round ones that closest to the middle."""
    middle = (low + high) / 2
    if low <= 0 <= high or not high > low:
        return 0.0 if low <= 0 <= high else middle
    for digits in range(-12, 16):
        unit = 10.0 ** -(digits - math.ceil(math.log10(max(abs(low), abs(high)))))
        for step in (unit, unit / 2):
            value = round(middle / step) * step
            if low <= value <= high:
                return float(f"{value:.12g}")
    return middle
