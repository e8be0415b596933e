"""Points of the trade, the Pareto set in time and one error, and what to run for a budget.

A point is in the Pareto set if no other is at least as fast and as accurate, and better in one of the two. Its
probability is the share of resamples of the test scenes (with replacement, the same scenes for all points) in which it
is; times stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm.evaluation.bootstrap import Floats, intervals, resampled_means
from nmpm.evaluation.figures import Unit
from nmpm.evaluation.trade.choices import Kind, Settings


@dataclass(frozen=True)
class Times:
    """Times of a choice.

    Args:
        milliseconds: Per computed frame and scene, of each round, see `Choice.computed_frames`.
        memory: Peak in bytes, None where it is not known.
        clock: "CPU time" or "wall time".
        hardware: Processor or GPU.
    """

    milliseconds: Sequence[float] = ()
    memory: float | None = None
    clock: str = ""
    hardware: str = ""


@dataclass(frozen=True, eq=False)
class Point:
    """A measured choice.

    Args:
        kind, name, settings, batch, device: Of the choice.
        times: Its times.
        errors: (S,) of each scene by name; NaN where the prediction failed.
        failures: Reasons for which scenes have no errors, or are unstable, by the scene's number.
        curves: (S, T) squared error of each frame, in length²; NaN where the prediction failed.
        frames: (F, N, D) positions of the first scene at the shown frames; None where that failed.
    """

    kind: Kind
    name: str
    settings: Settings
    batch: int
    device: str
    times: Times
    errors: Mapping[str, Floats]
    failures: Mapping[int, str]
    curves: Floats
    frames: Floats | None = None

    @cached_property
    def quartiles(self) -> tuple[float, float, float]:
        """Milliseconds per frame and scene: lower quartile, median, upper quartile; NaN where it was not timed."""
        low, middle, high = np.percentile(self.times.milliseconds or [math.nan], (25, 50, 75)).tolist()
        return low, middle, high

    @property
    def milliseconds(self) -> float:
        """Median time per frame and scene."""
        return self.quartiles[1]

    @property
    def stable(self) -> bool:
        """Whether no scene failed."""
        return not self.failures

    @property
    def competes(self) -> bool:
        """Whether a user can choose it: stable, timed, and no floor."""
        return self.kind is not Kind.FLOOR and self.stable and math.isfinite(self.milliseconds)

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
        return "scenes_differ_in" in self.settings


def measure_names(points: Sequence[Point]) -> list[str]:
    """Errors that all stable points have."""
    stable = [point for point in points if point.stable and point.errors]
    return [name for name in stable[0].errors if all(name in point.errors for point in stable)] if stable else []


@dataclass(frozen=True)
class Rank:
    """A point's mean error over scenes with its bootstrap interval of 95%, and its membership in the Pareto set.

    Args:
        mean, low, high: The error.
        member: Whether it is in the Pareto set: of one scene at a time if its batch is 1, else of all choices.
        probability: Share of resamples of the scenes in which it is a member.
    """

    mean: float
    low: float
    high: float
    member: bool = False
    probability: float = 0.0


def rank(points: Sequence[Point], measure: str = "mse") -> dict[str, Rank]:
    """The rank of each point that has the error in all scenes, by name."""
    measured = [point for point in points if math.isfinite(point.mean(measure))]
    if not measured:
        return {}
    errors = np.stack([point.errors[measure] for point in measured])
    ranks = {
        point.name: Rank(float(row.mean()), float(bounds[0]), float(bounds[1]))
        for point, row, bounds in zip(measured, errors, intervals(errors), strict=True)
    }
    for most in (math.inf, 1):  # points of one scene at a time compete among themselves: their times are latencies
        competing = [point.competes and point.batch <= most for point in measured]
        competitors = list(compress(measured, competing))
        times, rows = np.array([point.milliseconds for point in competitors]), errors[competing]
        members, shares = pareto_members(times, rows.mean(1)), pareto_probabilities(times, rows)
        for point, member, share in zip(competitors, members, shares, strict=True):
            ranks[point.name] = replace(ranks[point.name], member=bool(member), probability=float(share))
    return ranks


def pareto_members(times: Floats, errors: Floats) -> NDArray[np.bool_]:
    """Whether each of P points, with times (P,) and errors (..., P), is in the Pareto set, (..., P)."""
    time, other_time = times[:, None], times[None]
    error, other_error = errors[..., :, None], errors[..., None, :]
    better = (time < other_time) | (error < other_error)
    dominates = (time <= other_time) & (error <= other_error) & better
    return np.asarray(~dominates.any(axis=-2))


def pareto_probabilities(times: Floats, errors: Floats) -> Floats:
    """Share of resamples of the scenes in which each point is in the Pareto set, (P,), from errors (P, S)."""
    if not len(times):
        return np.zeros(0)
    members = [pareto_members(times, part) for part in np.array_split(resampled_means(errors), 20)]
    return np.asarray(np.concatenate(members).mean(axis=0))


class Recommendation(NamedTuple):
    """The choice to run for budgets from so many milliseconds per frame up to those of the next one, in words."""

    milliseconds: float
    name: str
    sentence: str


_DO = {
    Kind.MODEL: "Use the emulator",
    Kind.OTHER: "Use",
    Kind.SIMULATOR: "Run the",
    Kind.TRIVIAL: "Compute nothing: take",
}
_BEST = {Kind.MODEL: "the best emulator", Kind.SIMULATOR: "the best simulator setting"}


def recommend(points: Sequence[Point]) -> list[Recommendation]:
    """Recommend a choice for any budget of milliseconds per frame of one scene: steps from the least budget on."""
    ranks = rank(points)
    unit = Unit.of(one.mean for one in ranks.values())

    def error_of(point: Point) -> str:
        one = ranks[point.name]
        return f"{unit.show(one.mean, 3)} ({unit.show(one.low, 3)} to {unit.show(one.high, 3)}){unit}"

    def describe(point: Point, faster: Sequence[Point]) -> str:
        if point.exact:
            return f"Run the simulator as it is ({point.milliseconds:.3g} ms per frame): it made these data."
        facts = f"MSE of the full rollout {error_of(point)}, {point.milliseconds:.3g} ms per frame"
        others = [other for other in faster if other.kind in _BEST and other.kind is not point.kind]
        if others:
            best = min(others, key=lambda other: ranks[other.name].mean)
            facts += f"; {_BEST[best.kind]} there, {best.name}, has {error_of(best)}"
        return f"{_DO[point.kind]} {point.name}: {facts}."

    usable = [point for point in points if point.competes and point.batch == 1 and point.name in ranks]
    usable.sort(key=lambda point: (point.milliseconds, ranks[point.name].mean))
    steps: list[Recommendation] = []
    least = math.inf
    for index, point in enumerate(usable):
        if ranks[point.name].mean < least:
            least = ranks[point.name].mean
            steps.append(Recommendation(point.milliseconds, point.name, describe(point, usable[:index])))
    return steps


class Setting(NamedTuple):
    """A stable setting of the simulator: its name, milliseconds per frame, and error."""

    name: str
    milliseconds: float
    error: float


def at_equal_error(settings: Iterable[Setting], error: float) -> Setting | None:
    """The cheapest setting whose error is no larger than a model's; None if all have larger ones.

    Its time over the model's is the speed-up at equal error that tables, cards, the film, `nmpm demo`, `nmpm compare`
    and `nmpm trade` state.
    """
    accurate = [setting for setting in settings if setting.error <= error]
    return min(accurate, key=lambda setting: setting.milliseconds, default=None)


def beside_simulator(points: Sequence[Point]) -> str:
    """An emulator beside the simulator's stable settings, in a sentence; empty without either.

    The most accurate emulator; or a faster one whose error is within that one's interval.
    """
    timed = [point for point in points if point.competes and math.isfinite(point.mean("mse"))]
    models = [point for point in timed if point.kind is Kind.MODEL and point.batch == 1]
    if not models or all(point.kind is not Kind.SIMULATOR for point in points):
        return ""
    best = min(models, key=lambda model: model.mean("mse"))
    most = rank(points)[best.name].high
    model = min((one for one in models if one.mean("mse") <= most), key=lambda one: one.milliseconds)
    time, error = model.milliseconds, model.mean("mse")
    simulators = [
        Setting(point.name, point.milliseconds, point.mean("mse")) for point in timed if point.kind is Kind.SIMULATOR
    ]
    as_fast = [setting for setting in simulators if setting.milliseconds <= time]
    fast, good = "no stable simulator setting is as fast", "none is as accurate"
    if as_fast:
        best_one = min(as_fast, key=lambda setting: setting.error)
        fast = f"{best_one.name} is no slower and has {best_one.error / error:.2g} × its error"
    if as_good := at_equal_error(simulators, error):
        good = f"{as_good.name} is no less accurate and takes {as_good.milliseconds / time:.2g} × its time"
        if shipped := next((point for point in timed if point.exact and point.name != as_good.name), None):
            good += f" (the shipped setting, {shipped.name}, {shipped.milliseconds / time:.2g} ×)"
    which = (
        "The most accurate emulator" if model is best else "The fastest of the emulators that are as accurate as any"
    )
    return f"{which}, {model.name}, beside the simulator: {fast}; {good}."
