"""Validations of trainings: points of seconds, steps, MSE and overall error (`nmpm.metrics.overall_error`).

Points of earlier versions end with the MSE. Weights are compared by the overall error where all curves state it.
"""

from __future__ import annotations

from collections.abc import Sequence

Curve = Sequence[Sequence[float]]

_MSE, _OVERALL = 2, 3


def lowest_errors(*curves: Curve) -> list[float]:
    """The error of each curve's best weights, all by the same measure; infinite for an empty curve."""
    measured = [curve for curve in curves if curve]
    column = _OVERALL if all(_states_overall(curve) for curve in measured) else _MSE
    return [float(_best(curve)[column]) if curve else float("inf") for curve in curves]


def kept_mse(curve: Curve) -> float:
    """The full rollout's MSE of a curve's best weights; of a curve that is not empty."""
    return float(_best(curve)[_MSE])


def _best(curve: Curve) -> Sequence[float]:
    """The point whose weights were kept; of a curve that is not empty."""
    if not _states_overall(curve):
        return min(curve, key=lambda point: point[_MSE])
    return min((point for point in curve if len(point) > _OVERALL), key=lambda point: point[_OVERALL])


def _states_overall(curve: Curve) -> bool:
    """Whether its best weights were chosen by the overall error: in trainings that an earlier version began, too."""
    return any(len(point) > _OVERALL for point in curve)
