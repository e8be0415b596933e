"""Parabolas x + v t + ½ a t², fitted to the paths of particles over a few frames, and the acceleration most share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

AGREE = 0.1
"""Of an acceleration: others that differ by less agree with it."""
_CANDIDATES = 400  # particles
_STILL = 0.02  # of the spacing: particles that move less over a parabola are at rest
_STRAIGHT = 0.01  # of the velocity: its change over a straight flight, at most


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
class Flight:
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
        return float(np.linalg.norm(self.acceleration)) * self.duration**2 < _STRAIGHT * float(
            np.linalg.norm(self.travelled)
        )


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


def join(parts: Sequence[Parabolas]) -> Parabolas:
    """Parabolas of equal duration as one set."""
    return Parabolas(
        np.concatenate([part.velocity for part in parts]),
        np.concatenate([part.acceleration for part in parts]),
        np.concatenate([part.error for part in parts]),
        parts[0].duration,
    )


def shared_acceleration(parabolas: Parabolas, spacing: float) -> Flight | None:
    """The acceleration that most of the moving particles share; None where fewer than two move or agree."""
    span = parabolas.duration
    speed = np.linalg.norm(parabolas.velocity, axis=1)
    size = np.linalg.norm(parabolas.acceleration, axis=1)
    moving = parabolas.select(speed * span + size * span**2 > _STILL * spacing)
    if len(moving.error) < 2:
        return None
    some = np.random.default_rng(0).permutation(len(moving.error))[:_CANDIDATES]
    candidates = moving.select(some)
    reach = np.maximum(
        AGREE * np.linalg.norm(candidates.acceleration, axis=1),
        _STRAIGHT * np.linalg.norm(candidates.velocity, axis=1) / span,
    )
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
    return Flight(
        acceleration=alike.acceleration.mean(axis=0),
        error=scatter / math.sqrt(float(inside.sum())),
        share=float(inside.mean()),
        mean=moving.acceleration.mean(axis=0),
        travelled=np.median(np.abs(alike.velocity), axis=0) * span,
        duration=span,
    )
