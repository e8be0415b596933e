"""Points of the trade: time and errors of each choice."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.evaluation.trade.accuracy import FAILED, PICTURE, known_accuracy
from nmpm.evaluation.trade.choice import OTHER_SCENES, Choice, Kind
from nmpm.evaluation.trade.errors import GAIN, Measures
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.store import Store
from nmpm.evaluation.trade.timing import Times, Timing, known_times, quartiles

COMPETING = (Kind.MODEL, Kind.GRAPH, Kind.SIMULATOR, Kind.TRIVIAL)
"""Kinds that a user can choose; floors are not among them."""


@dataclass(frozen=True)
class Point:
    """A measured choice.

    Args:
        kind: What it is.
        name: Unique among the points.
        settings: What was chosen, by name.
        batch, threads, device: How it was timed.
        times: Its times.
        errors: Errors of each scene by name; NaN where a scene has none.
        failures: Reasons for which scenes have no errors, or are unstable, by the scene's number.
        dt: Seconds of a frame.
        picture: Particles of the first scene, half-way, as `accuracy.thumbnail` has them; empty where it failed.
    """

    kind: Kind
    name: str
    settings: Mapping[str, str | int | float]
    batch: int
    threads: int
    device: str
    times: Times
    errors: Mapping[str, NDArray[np.float64]]
    failures: Mapping[int, str]
    dt: float
    picture: str = ""

    @cached_property
    def quartiles(self) -> tuple[float, float, float]:
        """Milliseconds per frame and scene: lower quartile, median, upper quartile."""
        return quartiles(self.times.milliseconds)

    @property
    def milliseconds(self) -> float:
        """Median time per frame and scene."""
        return self.quartiles[1]

    @property
    def ratio(self) -> float:
        """Median over rounds of the time over the reference's."""
        return quartiles(self.times.ratios)[1]

    @property
    def frames_per_second(self) -> float:
        """Frames per second, of all scenes of a batch together."""
        return 1e3 / self.milliseconds if self.milliseconds > 0 else math.nan

    @property
    def milliseconds_per_second(self) -> float:
        """Milliseconds of computation for a second of the scene."""
        return self.milliseconds / self.dt

    @property
    def stable(self) -> bool:
        """Whether no scene failed."""
        return not self.failures

    @property
    def competes(self) -> bool:
        """Whether a user can choose it: stable, timed, and no floor."""
        return self.kind in COMPETING and self.stable and math.isfinite(self.milliseconds)

    def mean(self, measure: str) -> float:
        """An error's mean over scenes; NaN where it was not measured or a scene failed."""
        values = self.errors.get(measure)
        return float(values.mean()) if values is not None and len(values) else math.nan

    @property
    def exact(self) -> bool:
        """Whether it repeats the data: the simulator as it made them."""
        return self.mean("mse") < 1e-14

    @property
    def of_other_scenes(self) -> bool:
        """Whether it is a model that was trained on other scenes."""
        return str(self.settings.get("model", "")).endswith(OTHER_SCENES)


def collect_points(
    choices: Sequence[Choice], scenes: Scenes, measures: Measures, timing: Timing, store: Store
) -> list[Point]:
    """The points of choices, of all that the store knows."""
    return [
        _point(
            choice, known_accuracy(choice, scenes, measures, store), known_times(choice, scenes, timing, store), scenes
        )
        for choice in choices
    ]


def _point(choice: Choice, known: Sequence[Mapping[str, Any]], times: Times, scenes: Scenes) -> Point:
    names = dict.fromkeys(name for scene in known for name in scene if name not in (FAILED, PICTURE, GAIN))
    return Point(
        kind=choice.kind,
        name=choice.name,
        settings=choice.settings,
        batch=choice.batch,
        threads=choice.threads,
        device=choice.device.type,
        times=times,
        errors={name: np.array([scene.get(name, math.nan) for scene in known]) for name in names},
        failures={index: scene[FAILED] for index, scene in enumerate(known) if FAILED in scene},
        dt=scenes.scene.dt,
        picture=known[0].get(PICTURE, "") if known else "",
    )


def measure_names(points: Sequence[Point]) -> list[str]:
    """Errors that all stable points have, in order: full MSE, MSE at horizons, the others."""
    stable = [point for point in points if point.stable and point.errors]
    if not stable:
        return []
    shared = [name for name in stable[0].errors if all(name in point.errors for point in stable)]
    return sorted(shared, key=lambda name: (name != "mse", not name.startswith("mse@"), _horizon(name)))


def _horizon(name: str) -> int:
    return int(name.partition("@")[2] or 0)
