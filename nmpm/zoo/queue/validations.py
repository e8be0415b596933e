"""Validations of trainings: points of seconds, steps, MSE and overall error (`nmpm.metrics.overall_error`).

Points of earlier versions end with the MSE. Weights are compared by the overall error where all curves state it. As
validations have few scenes, so that a single one may be low by chance, an error is the mean of `GROUP` validations in a
row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Curve = Sequence[Sequence[float]]

GROUP = 3
_MSE, _OVERALL = 2, 3


def lowest_errors(*curves: Curve) -> list[float]:
    """The error where each curve is lowest, all by the same measure.

    Infinite for an empty curve, and for one with less than a group of validations where another has a group: it may be
    low by chance. Validations with a value that is not finite do not count.
    """
    curves = tuple(_finite(curve) for curve in curves)
    overall = all(_states_overall(curve) for curve in curves if curve)
    least = GROUP if any(len(curve) >= GROUP for curve in curves) else 1
    column = _OVERALL if overall else _MSE
    return [_lowest(curve)[column] if len(curve) >= least else float("inf") for curve in curves]


def lowest_mse(curve: Curve) -> float:
    """The full rollout's MSE where a curve is lowest; infinite where no validation is finite."""
    finite = _finite(curve)
    return _lowest(finite)[_MSE] if finite else math.inf


def ends_lowest(curve: Curve) -> bool:
    """Whether a curve is lower at its end than around its lowest single validation.

    A training keeps the weights of that validation, and the last ones. False where the last validation is not finite.
    """
    points, column = _measured(_finite(curve))
    if not points or list(points[-1]) != list(curve[-1]):
        return False
    single = min(range(len(points)), key=lambda at: points[at][column])
    return _mean(points[-GROUP:], column) < _mean(_around(points, single), column)


def _lowest(curve: Curve) -> list[float]:
    """Means of the columns around the point where those of the error are lowest; of a curve that is not empty."""
    points, column = _measured(curve)
    groups = [_around(points, at) for at in range(len(points))]
    lowest = min(groups, key=lambda group: _mean(group, column))
    return [_mean(lowest, index) for index in range(column + 1)]


def _around(points: Curve, at: int) -> Curve:
    """The group with a point in its middle, or the first or last one; all points where they are fewer."""
    start = max(0, min(at - GROUP // 2, len(points) - GROUP))
    return points[start : start + GROUP]


def _mean(points: Curve, column: int) -> float:
    return sum(point[column] for point in points) / len(points)


def _finite(curve: Curve) -> list[Sequence[float]]:
    """The validations of which all values are finite."""
    return [point for point in curve if all(math.isfinite(value) for value in point)]


def _measured(curve: Curve) -> tuple[Curve, int]:
    """The points by whose errors weights were kept, and the column of these."""
    if _states_overall(curve):
        return [point for point in curve if len(point) > _OVERALL], _OVERALL
    return curve, _MSE


def _states_overall(curve: Curve) -> bool:
    """Whether its best weights were chosen by the overall error: in trainings that an earlier version began, too."""
    return any(len(point) > _OVERALL for point in curve)
