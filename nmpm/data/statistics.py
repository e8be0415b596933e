"""Mean and standard deviation of velocities and accelerations, as in DeepMind's and LagrangeBench's metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.scene import Interval

STATISTICS_KEYS = ("vel_mean", "vel_std", "acc_mean", "acc_std")
_STILL = 1e-3  # of the extent; displacements up to it count as rest


class MotionStatistics:
    """Accumulates the moments of the moving particles' velocities and accelerations over trajectories.

    Velocities are differences of successive frames, in length per frame; accelerations are differences of velocities,
    in length per frame squared; both by minimum image on periodic axes.

    Args:
        metadata: States which types move and which axes are periodic.
    """

    def __init__(self, metadata: Metadata) -> None:
        self._moving = metadata.moving_types
        lower, upper = np.asarray(metadata.bounds).T
        self._period = np.where(metadata.periodic, upper - lower, np.inf)
        # Count, sum and sum of squares, per axis.
        self._sums = {"vel": np.zeros((3, metadata.dim)), "acc": np.zeros((3, metadata.dim))}

    def add(self, trajectory: Trajectory) -> None:
        """Adds a trajectory."""
        moving = np.isin(trajectory.particle_type, self._moving)
        velocity = np.diff(trajectory.position[:, moving].astype(np.float64), axis=0)
        wraps = np.isfinite(self._period)
        velocity[..., wraps] -= self._period[wraps] * np.round(velocity[..., wraps] / self._period[wraps])
        for key, values in (("vel", velocity), ("acc", np.diff(velocity, axis=0))):
            flat = values.reshape(-1, values.shape[-1])
            self._sums[key] += np.stack([np.full(flat.shape[1], len(flat)), flat.sum(0), (flat**2).sum(0)])

    def result(self) -> dict[str, list[float]]:
        """`vel_mean`, `vel_std`, `acc_mean` and `acc_std` per axis; those without any sample are left out."""
        found = {}
        for key, (count, total, squares) in self._sums.items():
            if count.all():
                mean = total / count
                found[f"{key}_mean"] = mean.tolist()
                found[f"{key}_std"] = np.sqrt(np.maximum(0.0, squares / count - mean**2)).tolist()
        return found


def find_disagreements(measured: Mapping[str, list[float]], stated: Mapping[str, Any], share: float = 0.1) -> list[str]:
    """Compares stated standard deviations with measured ones.

    Args:
        measured: From `MotionStatistics.result`.
        stated: The metadata's own; missing ones are skipped.
        share: Relative difference up to which they agree.

    Returns:
        A sentence for each that disagrees.
    """
    found = []
    for key in ("vel_std", "acc_std"):
        try:
            expected = np.asarray(stated[key], dtype=np.float64)
            found_std = np.asarray(measured[key])
        except (KeyError, TypeError, ValueError):
            continue
        if expected.shape != found_std.shape or not np.allclose(expected, found_std, rtol=share, atol=0):
            found.append(f"The metadata state {key} = {_short(expected)}; these trajectories have {_short(found_std)}.")
    return found


def _short(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.atleast_1d(values)) + ")"


def first_moving_particle(position: np.ndarray, chosen: np.ndarray, extent: Sequence[Interval]) -> int | None:
    """Index of the first of the chosen particles that is displaced by more than a thousandth of the extent, or None.

    Args:
        position: (T, N, D).
        chosen: (N,) bool, the particles to look at.
        extent: (lower, upper) per axis.
    """
    if not chosen.any():
        return None
    lower, upper = np.asarray(extent).T
    candidates = position[:, chosen]
    moves = (np.abs(candidates - candidates[0]) > _STILL * (upper - lower)).any(axis=(0, 2))
    return int(np.flatnonzero(chosen)[int(np.argmax(moves))]) if moves.any() else None
