"""Gravity of datasets and of single trajectories, in length/s².

The metadata may state one gravity, and trajectories their own as an attribute. Numbers are compared with a tolerance: a
float32 attribute beside the metadata's float64 is no other gravity.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import METADATA_FILE, Metadata, Split
from nmpm.data.metadata import Fact, Sure
from nmpm.data.statistics import evenly
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

Gravity = tuple[float, ...]


def trajectory_gravity(attributes: Mapping[str, Any], facts: Scene | Metadata, where: str) -> Gravity | None:
    """The gravity (D,) that a trajectory's attributes state, else its scene or dataset; None if neither does.

    Raises:
        DataError: naming `where`, if the attribute is not a finite number for each axis.
    """
    stated = attributes.get("gravity")
    if stated is None:
        return facts.gravity
    try:
        values = np.asarray(stated, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (facts.dim,) or not np.isfinite(values).all():
        raise DataError(
            f"{where}: the attribute gravity = {one_line(stated, 60)} should be {facts.dim} finite numbers."
        )
    return tuple(values.tolist())


def distinct_gravities(values: Iterable[Gravity | None]) -> tuple[Gravity, ...]:
    """The different ones among gravities, without None; one if all are the same."""
    distinct = tuple(dict.fromkeys(value for value in values if value is not None))
    return distinct[:1] if all(_equal(distinct[0], other) for other in distinct) else distinct


def _equal(one: Gravity, other: Gravity) -> bool:
    return len(one) == len(other) and np.allclose(one, other, atol=1e-6)


def check_gravity(given: Sequence[float], stated: Gravity | None, path: Path) -> None:
    """Raises a ConfigError if a user's gravity contradicts that of a file, which may state none."""
    values = tuple(map(float, given))
    if stated is not None and not _equal(values, stated):
        raise ConfigError(
            f"gravity = {list(values)} contradicts {path}, which states gravity {list(stated)}. Leave the option"
            f" out to use the file's; if the file is wrong, {_corrected_copy(values)}."
        )


def _corrected_copy(gravity: Gravity) -> str:
    return (
        f"write a corrected copy with nmpm convert FOLDER NEW --gravity={','.join(f'{value:g}' for value in gravity)}"
    )


def common_gravity(gravities: tuple[Gravity, ...], metadata: Metadata, split: Split) -> Gravity | None:
    """The metadata's gravity, or else that of all trajectories; None if neither is known.

    Raises:
        DataError: if all trajectories state one that is not the metadata's: models would learn theirs, and fall by the
            metadata's.
    """
    only = gravities[0] if len(gravities) == 1 else None
    if metadata.gravity and only is not None and not _equal(metadata.gravity, only):
        raise DataError(
            f"{split.path}: all trajectories have the attribute gravity {list(only)}, but {METADATA_FILE} states"
            f" {list(metadata.gravity)}. If the trajectories are right, {_corrected_copy(only)}; otherwise remove their"
            " attribute."
        )
    return metadata.gravity or only


_AGREE = 0.1  # of an acceleration: others that differ by less agree with it
_CANDIDATES = 400  # particles
_STILL = 0.02  # of the spacing: particles that move less over a parabola are at rest
_STRAIGHT = 0.01  # of the velocity: its change over a straight flight, at most
_FRAMES = (8, 4)  # of a parabola
_LONG = 32  # frames in which a flight must be straight
_SHARE = 0.2  # of the particles that move, that must be in free flight
_CLEAR = 0.5  # the same where they alone show gravity, or that it differs
_MOST = 0.6  # of the trajectories must agree
_MEAN_AGREE = 0.05  # of gravity
_LATER, _LATER_FRAMES, _LATER_SHARE = 24, 5, 0.05  # parabolas over a whole trajectory, their frames, share that agrees
_COMPARED_TRACKS, _LEAST_FITS = 4, 32  # of parabolas by which an acceleration is compared with velocities and places
_SIMILAR = 0.3  # of gravity: accelerations that differ by less are compared
_OPPOSITE, _NEARLY_ALL = 0.99, 0.95  # cosine, and share of the parabolas
_CHANGES, _EXPLAINED = 0.02, 0.6  # of gravity, and of the variance: a dependence that is more than noise
_EXACT = 0.01  # of gravity: smaller components are none
_ROUNDED = 5e-4  # of gravity
_BALANCED = 1e-3  # of single accelerations: a smaller mean is none, where only particles push each other


@dataclass(frozen=True)
class Parabolas:
    """Least-squares parabolas of N particles over a few frames, in length and frames."""

    velocity: np.ndarray  # (N, D) at mid time
    acceleration: np.ndarray  # (N, D)
    error: np.ndarray  # (N,) standard error of a component of the acceleration
    duration: float  # frames

    def select(self, which: np.ndarray) -> Parabolas:
        """Those of some particles."""
        return Parabolas(self.velocity[which], self.acceleration[which], self.error[which], self.duration)


@dataclass(frozen=True)
class FreeFlight:
    """What the particles of one trajectory share, in length and frames."""

    acceleration: np.ndarray  # (D,)
    error: float  # standard error
    share: float  # of the moving particles, that have this acceleration
    mean: np.ndarray  # (D,) acceleration of all moving particles
    travelled: np.ndarray  # (D,) distance flown along each axis
    duration: float

    @property
    def straight(self) -> bool:
        """Whether the velocity changes by less than 1%."""
        change = float(np.linalg.norm(self.acceleration)) * self.duration**2
        return change < _STRAIGHT * float(np.linalg.norm(self.travelled))


def fit_parabolas(position: np.ndarray, time: np.ndarray) -> Parabolas:
    """Fits parabolas to (F, N, D) positions at (F,) times, of particles present in all frames; F is at least 4."""
    points = position[:, np.isfinite(position).all(axis=(0, 2))]
    centred = time - time.mean()
    basis = np.stack([np.ones_like(centred), centred, centred**2 - np.mean(centred**2)], axis=1)
    flat = points.reshape(len(points), -1)
    solution = np.linalg.lstsq(basis, flat, rcond=None)[0]
    scatter = np.sqrt(((flat - basis @ solution) ** 2).sum(axis=0) / (len(points) - 3))
    curvature = math.sqrt(float(np.linalg.inv(basis.T @ basis)[2, 2]))
    shape = points.shape[1:]
    return Parabolas(
        velocity=solution[1].reshape(shape),
        acceleration=2 * solution[2].reshape(shape),
        error=2 * curvature * scatter.reshape(shape).max(axis=1, initial=0.0),
        duration=float(time[-1] - time[0]),
    )


def shared_acceleration(parabolas: Parabolas, spacing: float) -> FreeFlight | None:
    """The acceleration that most of the moving particles share; None where fewer than two move or agree."""
    span = parabolas.duration
    speed = np.linalg.norm(parabolas.velocity, axis=1)
    size = np.linalg.norm(parabolas.acceleration, axis=1)
    moving = parabolas.select(speed * span + size * span**2 > _STILL * spacing)
    if len(moving.error) < 2:
        return None
    candidates = moving.select(np.random.default_rng(0).permutation(len(moving.error))[:_CANDIDATES])
    speed, size = (np.linalg.norm(vectors, axis=1) for vectors in (candidates.velocity, candidates.acceleration))
    reach = np.maximum(_AGREE * size, _STRAIGHT * speed / span)
    distance = np.linalg.norm(candidates.acceleration[:, None] - candidates.acceleration[None], axis=2)
    near = (distance < reach[:, None]) & (candidates.error[None] < reach[:, None])
    # Of candidates with equally many neighbours, the one that is closest to them.
    closeness = (distance * near).sum(axis=1) / np.maximum(reach * near.sum(axis=1), 1e-300)
    best = int(np.argmax(near.sum(axis=1) - closeness))
    off = np.linalg.norm(moving.acceleration - candidates.acceleration[best], axis=1)
    inside = (off < reach[best]) & (moving.error < reach[best])
    if inside.sum() < 2:
        return None
    alike = moving.select(inside)
    scatter = float(alike.acceleration.std(axis=0).max() + np.median(alike.error))
    return FreeFlight(
        acceleration=alike.acceleration.mean(axis=0),
        error=scatter / math.sqrt(float(inside.sum())),
        share=float(inside.mean()),
        mean=moving.acceleration.mean(axis=0),
        travelled=np.median(np.abs(alike.velocity), axis=0) * span,
        duration=span,
    )


@dataclass(frozen=True)
class Track:
    """Moving particles of a trajectory from its first frame on, in length and frames."""

    position: np.ndarray  # (F, N, D), without jumps along periodic axes; NaN where absent
    time: np.ndarray  # (F,)

    def flight(self, start: int, frames: int, spacing: float) -> FreeFlight | None:
        """The acceleration that particles share over some frames."""
        window = slice(start, start + frames)
        fits = len(self.position) >= window.stop
        return shared_acceleration(fit_parabolas(self.position[window], self.time[window]), spacing) if fits else None


def find_gravity(tracks: Sequence[Track], spacing: float, dt: float, closed: bool) -> Fact[Gravity | None]:
    """Gravity in length per time², or None where trajectories do not show it.

    `spacing` is the typical distance of neighbours, `dt` the time between frames. In a `closed` space all axes are
    periodic and there are no obstacles, so that only gravity changes momentum.
    """
    number = len(tracks)
    flights = [flight for flight in (_first_flight(track, spacing) for track in tracks) if flight is not None]
    free = [flight for flight in flights if flight.share >= _SHARE]
    straight = [flight for flight in free if flight.straight]
    if straight and 2 * len(straight) >= len(free):
        return _no_gravity(straight, number, spacing, dt)
    if alike := _agreeing([flight.acceleration for flight in free], _AGREE):
        return _from_flights([free[index] for index in alike], number, dt, _speaks_against(tracks, free))
    clear = [flight for flight in free if flight.share > _CLEAR]
    if len(clear) >= 2 and 2 * len(clear) >= number:
        return _differing(clear, number, dt)
    means = [flight.mean for flight in flights]
    if len(means) >= 3 and len(_agreeing(means, _MEAN_AGREE)) == len(means):
        how = f"mean acceleration of all particles in first frames of {len(means)} of {number} trajectories"
        return _gravity(means, dt, how, "likely")
    later = [flight for flight in (_later_flight(track, spacing) for track in tracks) if flight is not None]
    alike = _agreeing([flight.acceleration for flight in later], _AGREE)
    if len(alike) >= 2:
        how = f"particles in flight at any time in {len(alike)} of {number} trajectories"
        return _gravity([later[index].acceleration for index in alike], dt, how, "likely")
    if closed and (momentum := _from_momentum(tracks, dt)):
        return momentum
    return Fact(None, f"{_why_not(tracks, flights, spacing)}.", "guessed")


def _first_flight(track: Track, spacing: float) -> FreeFlight | None:
    """The flight in first frames: over few of them where more agree, over many where it is straight so far."""
    flights = [track.flight(0, frames, spacing) for frames in _FRAMES]
    best = max((flight for flight in flights if flight), key=lambda flight: min(flight.share, _CLEAR), default=None)
    if best is not None and best.straight:
        half = _LONG // 2
        halves = [track.flight(start, half, spacing) for start in (0, half)]
        longer = track.flight(0, _LONG, spacing)
        if longer and all(part and _same(part.acceleration, longer.acceleration, 2 * _AGREE) for part in halves):
            return longer
    return best


def _same(one: np.ndarray, other: np.ndarray, tolerance: float) -> bool:
    return bool(np.linalg.norm(one - other) < tolerance * np.linalg.norm(other))


def _later_flight(track: Track, spacing: float) -> FreeFlight | None:
    """The acceleration that particles share at any time, among those that are clearly accelerated."""
    final = len(track.position) - _LATER_FRAMES
    if final < 0:
        return None
    windows = [slice(start, start + _LATER_FRAMES) for start in evenly(final + 1, _LATER)]
    fits = [fit_parabolas(track.position[window], track.time[window]) for window in windows]
    columns = zip(*((fit.velocity, fit.acceleration, fit.error) for fit in fits), strict=True)
    velocity, acceleration, error = map(np.concatenate, columns)
    every = Parabolas(velocity, acceleration, error, fits[0].duration)
    size = np.linalg.norm(every.acceleration, axis=1)
    flight = shared_acceleration(every.select(every.error < _AGREE / 2 * size), spacing)
    return flight if flight is not None and not flight.straight and flight.share > _LATER_SHARE else None


def _agreeing(vectors: Sequence[np.ndarray], tolerance: float) -> list[int]:
    """Indices of the vectors that agree with the median of all, if they are most of them."""
    if not vectors:
        return []
    median = np.median(vectors, axis=0)
    agree = np.linalg.norm(np.stack(vectors) - median, axis=1) <= tolerance * np.linalg.norm(median)
    return np.flatnonzero(agree).tolist() if agree.mean() > _MOST else []


def _speaks_against(tracks: Sequence[Track], flights: Sequence[FreeFlight]) -> str:
    """Why an acceleration that particles share may be no gravity, which is the same at all velocities, places, times.

    Drag changes with the velocity, a spring or a field with the place, and friction is opposite to the velocity.
    """
    shared = np.median([flight.acceleration for flight in flights], axis=0)
    size = float(np.linalg.norm(shared))
    accelerations, velocities, places = [], [], []
    for track in tracks[:_COMPARED_TRACKS]:
        for start in range(0, min(2 * _LONG, len(track.position) - _FRAMES[0] + 1), _FRAMES[0]):
            window = slice(start, start + _FRAMES[0])
            path = track.position[window, : _CANDIDATES // 4]
            there = np.isfinite(path).all(axis=(0, 2))
            fitted = fit_parabolas(path, track.time[window])
            free = np.linalg.norm(fitted.acceleration - shared, axis=1) < _SIMILAR * size
            free &= fitted.error < _AGREE * size
            accelerations.append(fitted.acceleration[free])
            velocities.append(fitted.velocity[free])
            places.append(path.mean(axis=0)[there][free])
    if sum(map(len, accelerations)) < _LEAST_FITS:
        return ""
    acceleration, velocity, place = map(np.concatenate, (accelerations, velocities, places))
    along = (velocity * acceleration).sum(axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    braked = along < -_OPPOSITE * speed * np.linalg.norm(acceleration, axis=1)
    if braked.mean() > _NEARLY_ALL:
        return "it is opposite to their velocity, as friction and drag are"
    explained = {
        "their velocity, as drag does": _explained(acceleration, velocity, size),
        "their place, as a spring or a field does": _explained(acceleration, place, size),
    }
    most = max(explained, key=lambda what: explained[what])
    return f"it changes with {most}" if explained[most] > _EXPLAINED else ""


def _explained(acceleration: np.ndarray, cause: np.ndarray, size: float) -> float:
    """The part of the variance of (n, D) accelerations that a linear function of a cause explains; 0 if it is small."""
    change = acceleration - acceleration.mean(axis=0)
    basis = cause - cause.mean(axis=0)
    fitted = basis @ np.linalg.lstsq(basis, change, rcond=None)[0]
    if math.sqrt(float((fitted**2).sum(axis=1).mean())) < _CHANGES * size:
        return 0.0
    return float((fitted**2).sum() / (change**2).sum())


def _from_flights(flights: Sequence[FreeFlight], number: int, dt: float, against: str) -> Fact[Gravity | None]:
    vectors = [flight.acceleration for flight in flights]
    share = float(np.median([flight.share for flight in flights]))
    means = sum(_same(flight.mean, flight.acceleration, _AGREE) for flight in flights)
    how = (
        f"free flight of {share:.0%} of the particles in first frames of {len(flights)} of {number} trajectories, the"
        f" mean acceleration of all in {means}"
    )
    if against:
        return _gravity(vectors, dt, f"{how}, but {against}", "likely")
    clear = means or (share > _CLEAR and len(flights) > 1)
    return _gravity(vectors, dt, how if clear else f"{how}: others collide", "measured" if clear else "likely")


def _gravity(vectors: Sequence[np.ndarray], dt: float, how: str, sure: Sure) -> Fact[Gravity | None]:
    """Their median, rounded, in length per time²."""
    centre = np.median(vectors, axis=0)
    size = float(np.linalg.norm(centre))
    spread = max(float(np.linalg.norm(vector - centre)) for vector in vectors) / size
    digits = -math.floor(math.log10(max(spread / math.sqrt(len(vectors)), _ROUNDED) * size / dt**2))
    parts = np.where(np.abs(centre) > max(_EXACT, spread) * size, centre / dt**2, 0.0).tolist()
    value = tuple(round(part, digits) + 0.0 for part in parts)
    return Fact(value, f"{how}; they agree to {max(spread, 1e-3):.1%}.", sure)


def _no_gravity(flights: Sequence[FreeFlight], number: int, spacing: float, dt: float) -> Fact[Gravity | None]:
    """No gravity, where straight flights go along all axes."""
    travelled = np.max([flight.travelled for flight in flights], axis=0)
    count = f"in {len(flights)} of {number} trajectories"
    if not (travelled > spacing / 10).all():
        names = "".join("xyz"[axis] for axis in np.flatnonzero(travelled > spacing / 10))
        return Fact(None, f"particles move straight, but only along {names}, {count}.", "guessed")
    least = max(float(np.linalg.norm(flight.acceleration)) + 3 * flight.error for flight in flights) / dt**2
    how = f"particles fly straight {count}; gravity would be less than {least:.2g}."
    return Fact((0.0,) * len(travelled), how, "measured" if len(flights) > 1 else "likely")


def _differing(flights: Sequence[FreeFlight], number: int, dt: float) -> Fact[Gravity | None]:
    accelerations = [", ".join(f"{part / dt**2:.3g}" for part in flight.acceleration) for flight in flights[:3]]
    few = "; ".join(f"({values})" for values in accelerations)
    how = f"it differs: free flight in {len(flights)} of {number} trajectories shows {few} …"
    return Fact(None, f"{how}; state it in each trajectory's attribute `gravity`.", "measured")


def _from_momentum(tracks: Sequence[Track], dt: float) -> Fact[Gravity | None] | None:
    """Gravity from the mean acceleration of all particles; None where it is not steady."""
    second = [np.diff(track.position, 2, axis=0) for track in tracks]
    complete = [each[np.isfinite(each).all(axis=2)] for each in second]
    complete = [each for each in complete if len(each)]
    if not complete:
        return None
    single = math.sqrt(float(np.mean([np.mean(each**2) for each in complete])))
    means = [each.mean(axis=0) for each in complete]
    if all(np.linalg.norm(mean) < _BALANCED * single for mean in means):
        how = "all axes are periodic, and the mean acceleration is below 0.1% of single particles'."
        return Fact((0.0,) * len(means[0]), how, "measured")
    if len(means) > 1 and len(_agreeing(means, _MEAN_AGREE)) == len(means):
        return _gravity(means, dt, "all axes are periodic; mean acceleration of all particles", "likely")
    return None


def _why_not(tracks: Sequence[Track], flights: Sequence[FreeFlight], spacing: float) -> str:
    starts = [track.position[: _FRAMES[0]] for track in tracks]
    reach = [(np.fmax.reduce(start, axis=0) - np.fmin.reduce(start, axis=0)).max(axis=1) for start in starts]
    moved = np.concatenate([np.empty(0), *reach])
    moved = moved[np.isfinite(moved)]
    if len(moved) and np.median(moved) < spacing / 50:
        return "most particles are at rest in first frames"
    if not flights:
        return "paths in first frames are no parabolas: they are noisy, or particles push each other"
    return "too few particles share an acceleration in first frames: they push each other, or touch walls"
