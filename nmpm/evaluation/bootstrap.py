"""Uncertainty of means over a few test scenes: the percentile bootstrap over scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 2000
_LEVELS = (2.5, 97.5)


def resampled_means(errors: Floats, seed: int = 0, resamples: int = RESAMPLES) -> Floats:
    """Mean errors (R, P) in resamples of S scenes, from the errors (P, S) of P points; deterministic for a seed."""
    scenes = errors.shape[1]
    chosen = np.random.default_rng(seed).integers(0, scenes, (resamples, scenes))
    weights = np.stack([np.bincount(row, minlength=scenes) for row in chosen]) / scenes
    return np.asarray(weights @ errors.T)


def intervals(errors: Floats, seed: int = 0) -> Floats:
    """Bootstrap intervals (P, 2) of 95% of the mean errors of P points in S scenes, (P, S)."""
    return np.percentile(resampled_means(errors, seed), _LEVELS, axis=0).T


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Bootstrap interval of 95% of the mean of one figure over scenes; the value itself where there is one scene."""
    low, high = intervals(np.asarray([values], dtype=np.float64))[0]
    return float(low), float(high)


def ratio_interval(
    ours: Sequence[float], theirs: Sequence[float], resamples: int = RESAMPLES
) -> tuple[float, float, float]:
    """Ratio of the means of two figures over the same scenes, and its interval of 95%, paired: both resampled alike."""
    values = np.array([ours, theirs])
    means = resampled_means(values, resamples=resamples)
    low, high = np.percentile(means[:, 0] / means[:, 1], _LEVELS)
    return float(values[0].mean() / values[1].mean()), float(low), float(high)
