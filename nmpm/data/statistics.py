"""Mean and standard deviation of velocities and accelerations, as DeepMind's and LagrangeBench's metadata give them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.scene import Interval

KEYS = ("vel_mean", "vel_std", "acc_mean", "acc_std")
_STILL = 1e-3


class MotionStatistics:
    """Gathers, trajectory by trajectory, the moments of what the moving particles do.

    Velocities are differences of successive frames, in length per frame, and accelerations theirs, in length per
    frame squared; across a periodic axis the shortest way counts.

    Args:
        metadata: Which types move, and which axes wrap.
    """

    def __init__(self, metadata: Metadata) -> None:
        self._moving = metadata.moving_types
        lower, upper = np.asarray(metadata.bounds).T
        self._period = np.where(metadata.periodic, upper - lower, np.inf)
        # Number, sum and sum of squares, per axis.
        self._sums = {"vel": np.zeros((3, metadata.dim)), "acc": np.zeros((3, metadata.dim))}

    def add(self, trajectory: Trajectory) -> None:
        """Takes a trajectory into account."""
        moving = np.isin(trajectory.particle_type, self._moving)
        velocity = np.diff(trajectory.position[:, moving].astype(np.float64), axis=0)
        wraps = np.isfinite(self._period)
        velocity[..., wraps] -= self._period[wraps] * np.round(velocity[..., wraps] / self._period[wraps])
        for key, values in (("vel", velocity), ("acc", np.diff(velocity, axis=0))):
            flat = values.reshape(-1, values.shape[-1])
            self._sums[key] += np.stack([np.full(flat.shape[1], len(flat)), flat.sum(0), (flat**2).sum(0)])

    def result(self) -> dict[str, list[float]]:
        """`vel_mean`, `vel_std`, `acc_mean` and `acc_std` per axis; without those that nothing was seen of."""
        found = {}
        for key, (count, total, squares) in self._sums.items():
            if count.all():
                mean = total / count
                found[f"{key}_mean"] = mean.tolist()
                found[f"{key}_std"] = np.sqrt(np.maximum(0.0, squares / count - mean**2)).tolist()
        return found


def find_disagreements(measured: Mapping[str, list[float]], stated: Mapping[str, Any], share: float = 0.1) -> list[str]:
    """Standard deviations that a file states otherwise than they are, as sentences.

    Args:
        measured: From `MotionStatistics.result`.
        stated: The metadata's own, as far as there are any.
        share: From which difference, as a share of the measured value.
    """
    found = []
    for key in ("vel_std", "acc_std"):
        try:
            said = np.asarray(stated[key], dtype=np.float64)
            was = np.asarray(measured[key])
        except (KeyError, TypeError, ValueError):
            continue
        if said.shape != was.shape or not np.allclose(said, was, rtol=share, atol=0):
            found.append(f"The metadata state {key} = {_short(said)}; these trajectories have {_short(was)}.")
    return found


def _short(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.atleast_1d(values)) + ")"


def first_moving_particle(position: np.ndarray, chosen: np.ndarray, extent: Sequence[Interval]) -> int | None:
    """The first of the chosen particles that leaves its first place, by more than a thousandth of the extent.

    Args:
        position: (T, N, D).
        chosen: (N,) truth values.
        extent: (lower, upper) per axis.
    """
    if not chosen.any():
        return None
    lower, upper = np.asarray(extent).T
    candidates = position[:, chosen]
    moves = (np.abs(candidates - candidates[0]) > _STILL * (upper - lower)).any(axis=(0, 2))
    return int(np.flatnonzero(chosen)[int(np.argmax(moves))]) if moves.any() else None
