"""Intervals of errors and membership in the Pareto set, both under resampling of the test scenes.

A point is in the Pareto set if no other is at least as fast and as accurate, and better in one of the two. Its
probability is the share of resamples (with replacement, the same scenes for all points) in which it is; times stay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 2000
_LEVELS = (2.5, 97.5)


def resampled_means(errors: Floats, seed: int = 0, resamples: int = RESAMPLES) -> Floats:
    """Mean errors (R, P) in resamples of S scenes, from the errors (P, S) of P points; the same seed, the same bits."""
    scenes = errors.shape[1]
    chosen = np.random.default_rng(seed).integers(0, scenes, (resamples, scenes))
    weights = np.stack([np.bincount(row, minlength=scenes) for row in chosen]) / scenes
    return np.asarray(weights @ errors.T)


def intervals(errors: Floats, seed: int = 0) -> Floats:
    """Bootstrap intervals (P, 2) of 95% of the mean errors of P points in S scenes, (P, S)."""
    return np.percentile(resampled_means(errors, seed), _LEVELS, axis=0).T


def pareto_members(times: Floats, errors: Floats) -> NDArray[np.bool_]:
    """Whether each of P points, with times (P,) and errors (..., P), is in the Pareto set, (..., P)."""
    faster = times[:, None] < times[None]
    as_fast = times[:, None] <= times[None]
    better = errors[..., :, None] < errors[..., None, :]
    as_good = errors[..., :, None] <= errors[..., None, :]
    dominates = as_fast & as_good & (faster | better)
    return np.asarray(~dominates.any(axis=-2))


def pareto_probabilities(times: Floats, errors: Floats, seed: int = 0) -> Floats:
    """Share of resamples of the scenes in which each point is in the Pareto set, (P,), from errors (P, S)."""
    if not len(times):
        return np.zeros(0)
    members = [pareto_members(times, part) for part in np.array_split(resampled_means(errors, seed), 20)]
    return np.asarray(np.concatenate(members).mean(axis=0))
