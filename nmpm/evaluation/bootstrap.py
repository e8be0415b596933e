"""Uncertainty of means over a few test scenes: the percentile bootstrap over scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 2000
_LEVELS = (2.5, 97.5)


def resampled_means(errors: Floats, seed: int = 0) -> Floats:
    """Mean errors (R, P) in resamples of S scenes, from the errors (P, S) of P points; deterministic for a seed."""
    scenes = errors.shape[1]
    drawn = np.random.default_rng(seed).integers(0, scenes, (RESAMPLES, scenes))
    weights = np.stack([np.bincount(row, minlength=scenes) for row in drawn]) / scenes
    return np.asarray(weights @ errors.T)


def intervals(errors: Floats) -> Floats:
    """Bootstrap intervals (P, 2) of 95% of the mean errors of P points in S scenes, (P, S)."""
    return np.percentile(resampled_means(errors), _LEVELS, axis=0).T


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Bootstrap interval of 95% of the mean of one figure over scenes; the value itself where there is one scene."""
    low, high = intervals(np.asarray([values], dtype=np.float64))[0]
    return float(low), float(high)
