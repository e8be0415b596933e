"""Displacements of particles, and their statistics as in DeepMind's and LagrangeBench's metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.scene import Interval

STATISTICS_KEYS = ("vel_mean", "vel_std", "acc_mean", "acc_std")
_STILL = 1e-3  # of the extent; displacements up to it count as rest


def displacements(position: np.ndarray, metadata: Metadata) -> np.ndarray:
    """(T - 1, N, D) float64 displacements between successive frames, by minimum image on periodic axes."""
    lower, upper = np.asarray(metadata.bounds).T
    step: np.ndarray = np.diff(position.astype(np.float64), axis=0)
    for axis in np.flatnonzero(metadata.periodic):
        period = upper[axis] - lower[axis]
        step[..., axis] -= period * np.round(step[..., axis] / period)
    return step


class MotionStatistics:
    """Accumulates the moments of the moving particles' velocities and accelerations over trajectories.

    Velocities are differences of successive frames, in length per frame; accelerations are differences of velocities,
    in length per frame squared.

    Args:
        metadata: States which types move and which axes are periodic.
    """

    def __init__(self, metadata: Metadata) -> None:
        self._metadata = metadata
        # Count, sum and sum of squares, per axis.
        self._sums = {"vel": np.zeros((3, metadata.dim)), "acc": np.zeros((3, metadata.dim))}

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        moving = np.isin(trajectory.particle_type, self._metadata.moving_types)
        velocity = displacements(trajectory.position[:, moving], self._metadata)
        for key, values in (("vel", velocity), ("acc", np.diff(velocity, axis=0))):
            flat = values.reshape(-1, values.shape[-1])
            self._sums[key] += np.stack([np.full(flat.shape[1], len(flat)), flat.sum(0), (flat**2).sum(0)])

    def result(self) -> dict[str, list[float]]:
        """`vel_mean`, `vel_std`, `acc_mean` and `acc_std` per axis; those without any sample are left out."""
        statistics = {}
        for key, (count, total, squares) in self._sums.items():
            if count.all():
                mean = total / count
                statistics[f"{key}_mean"] = mean.tolist()
                statistics[f"{key}_std"] = np.sqrt(np.maximum(0.0, squares / count - mean**2)).tolist()
        return statistics


def find_disagreements(measured: Mapping[str, list[float]], stated: Mapping[str, Any], share: float = 0.1) -> list[str]:
    """Compares stated standard deviations with measured ones.

    Args:
        measured: From `MotionStatistics.result`.
        stated: The metadata's; missing ones are skipped.
        share: Relative difference up to which they agree.

    Returns:
        A sentence for each that disagrees.
    """
    sentences = []
    for key in ("vel_std", "acc_std"):
        try:
            expected = np.asarray(stated[key], dtype=np.float64)
            actual = np.asarray(measured[key])
        except (KeyError, TypeError, ValueError):
            continue
        if expected.shape != actual.shape or not np.allclose(expected, actual, rtol=share, atol=0):
            shown = f"{_short(expected)}; these trajectories have {_short(actual)}"
            sentences.append(f"The metadata state {key} = {shown}.")
    return sentences


def _short(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.atleast_1d(values)) + ")"


def first_moving_particle(position: np.ndarray, particles: np.ndarray, extent: Sequence[Interval]) -> int | None:
    """Index of the first of some particles that is displaced by more than a thousandth of the extent, or None.

    Args:
        position: (T, N, D).
        particles: (N,) bool, the particles to look at.
        extent: (lower, upper) per axis.
    """
    if not particles.any():
        return None
    lower, upper = np.asarray(extent).T
    candidates = position[:, particles]
    moves = (np.abs(candidates - candidates[0]) > _STILL * (upper - lower)).any(axis=(0, 2))
    return int(np.flatnonzero(particles)[int(np.argmax(moves))]) if moves.any() else None
