"""Membership in the Pareto set, also under resampling of the test scenes.

A point is in the Pareto set if no other is at least as fast and as accurate, and better in one of the two. Its
probability is the share of resamples (with replacement, the same scenes for all points) in which it is; times stay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nmpm.evaluation.bootstrap import Floats, resampled_means


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
