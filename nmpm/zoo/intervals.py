"""What a mean over a few test scenes is uncertain by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def bootstrap_interval(values: Sequence[float], share: float = 0.95, draws: int = 2000) -> tuple[float, float]:
    """The interval of the mean over scenes, by the percentile bootstrap.

    Args:
        values: A figure of each scene.
        share: Of the means of resampled scenes within the interval.
        draws: Resamplings; always the same ones.

    Returns:
        Lower and upper end; both the value itself where there is only one scene.
    """
    known = np.asarray(values, dtype=np.float64)
    chosen = np.random.default_rng(0).integers(len(known), size=(draws, len(known)))
    low, high = np.quantile(known[chosen].mean(axis=1), [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)
