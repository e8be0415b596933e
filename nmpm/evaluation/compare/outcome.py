"""The measurements of one predictor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.evaluation.bootstrap import interval
from nmpm.evaluation.compare.predictors import Candidate
from nmpm.evaluation.trade.choice import Kind
from nmpm.evaluation.trade.timing import Times, quartiles

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors and times of one predictor on S scenes.

    Args:
        candidate: What predicted.
        errors: (S,) of each scene by name, see `nmpm.evaluation.trade.errors`; NaN where the prediction failed.
        curves: (S, T) squared error of each frame, a mean over particles and dimensions, in length²; NaN likewise.
        frames: (F, N, D) positions of the first scene at the shown frames; None where that failed.
        failures: Why a scene has no errors, or its prediction is unstable, by the scene's number.
        times: Milliseconds per frame, one scene at a time.
    """

    candidate: Candidate
    errors: Mapping[str, Floats]
    curves: Floats
    frames: Floats | None
    failures: Mapping[int, str]
    times: Times

    @property
    def name(self) -> str:
        """Name of the predictor."""
        return self.candidate.choice.name

    @property
    def kind(self) -> Kind:
        """Kind of the predictor."""
        return self.candidate.choice.kind

    @property
    def milliseconds(self) -> tuple[float, float, float]:
        """Per frame: lower quartile, median, upper quartile; NaN where it was not timed."""
        return quartiles(self.times.milliseconds)

    def mean(self, name: str) -> float:
        """The mean of an error over scenes; NaN where one of them has none."""
        values = self.errors.get(name)
        return math.nan if values is None or not len(values) else float(values.mean())

    def interval(self, name: str) -> tuple[float, float]:
        """Bootstrap interval of 95% of the mean over scenes; NaN where one of them has no error."""
        values = self.errors.get(name)
        if values is None or not np.isfinite(values).all():
            return math.nan, math.nan
        return interval(values.tolist())

    def to_dict(self) -> dict[str, Any]:
        """All figures as plain data; lengths in domain length, times in milliseconds; None where there is none.

        `weights` is the digest of a model's weights, see `nmpm._support.digests`.
        """
        low, middle, high = self.milliseconds
        return {
            "name": self.name,
            "kind": self.kind.value,
            "settings": dict(self.candidate.choice.settings),
            "weights": self.candidate.choice.identity.get("weights"),
            "scenes_differ_in": list(self.candidate.differing),
            "errors": {
                name: {
                    "mean": _plain(self.mean(name)),
                    "interval": [_plain(value) for value in self.interval(name)],
                    "scenes": [_plain(value) for value in values.tolist()],
                }
                for name, values in self.errors.items()
            },
            "ms_per_frame": {"median": _plain(middle), "quartiles": [_plain(low), _plain(high)]},
            "ratio_to_first": _plain(quartiles(self.times.ratios)[1]),
            "failures": {str(scene): reason for scene, reason in self.failures.items()},
            "curve": [_plain(value) for value in self.curves.mean(0).tolist()],
        }


def _plain(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None
