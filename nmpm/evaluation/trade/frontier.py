"""The frontier of one error: intervals, membership in the Pareto set, and what to run for a budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from types import MappingProxyType

import numpy as np

from nmpm.evaluation.bootstrap import intervals
from nmpm.evaluation.figures import Unit
from nmpm.evaluation.trade.choice import Kind
from nmpm.evaluation.trade.pareto import pareto_members, pareto_probabilities
from nmpm.evaluation.trade.points import Point

MEASURES: Mapping[str, str] = MappingProxyType(
    {
        "mse": "MSE of the full rollout",
        "field": "share of the material in another cell",
        "emd": "earth mover's distance",
        "kinetic": "kinetic energy, relative error",
        "height": "settled height, relative error",
        "crowding": "particles per cell, relative error",
    }
)

POOLS: Mapping[str, Callable[[Point], bool]] = MappingProxyType(
    {
        "everything": lambda _: True,
        "no simulator": lambda point: point.kind is not Kind.SIMULATOR,
    }
)
"""Which points a user can choose from, by name: recorded data come without a simulator."""


@dataclass(frozen=True)
class Standing:
    """A point's mean error with its interval, and its membership in the Pareto set.

    Args:
        mean: Over scenes.
        low, high: Bootstrap interval of 95%.
        member: Whether it is in the Pareto set: of one scene at a time if its batch is 1, else of all choices.
        probability: Share of resamples of the scenes in which it is a member.
    """

    mean: float
    low: float
    high: float
    member: bool = False
    probability: float = 0.0


@dataclass(frozen=True)
class Advice:
    """What to run for budgets from `milliseconds` up to that of the next advice.

    Args:
        milliseconds: Smallest budget per frame for which it holds.
        name: Name of the choice; empty where nothing is fast enough.
        sentence: The advice in words.
    """

    milliseconds: float
    name: str
    sentence: str


def describe_measure(name: str) -> str:
    """An error in words."""
    return MEASURES.get(name, f"MSE of the first {name.partition('@')[2]} frames")


def standings(points: Sequence[Point], measure: str, seed: int = 0) -> dict[str, Standing]:
    """The standing of each point that has the error in all scenes, by name."""
    known = [point for point in points if math.isfinite(point.mean(measure))]
    if not known:
        return {}
    errors = np.stack([point.errors[measure] for point in known])
    found = {
        point.name: Standing(float(row.mean()), float(bounds[0]), float(bounds[1]))
        for point, row, bounds in zip(known, errors, intervals(errors, seed), strict=True)
    }
    for most in (math.inf, 1):  # points of one scene at a time compete among themselves: their times are latencies
        chosen = [point.competes and point.batch <= most for point in known]
        rivals = list(compress(known, chosen))
        times, rows = np.array([point.milliseconds for point in rivals]), errors[chosen]
        members, shares = pareto_members(times, rows.mean(1)), pareto_probabilities(times, rows, seed)
        for point, member, share in zip(rivals, members, shares, strict=True):
            found[point.name] = replace(found[point.name], member=bool(member), probability=float(share))
    return found


def advise(points: Sequence[Point], measure: str, pool: str = "everything", seed: int = 0) -> list[Advice]:
    """What to run for any budget of milliseconds per frame of one scene: steps from the least budget on.

    Args:
        points: All of them; those that predict several scenes at once are left out, as a budget is for one scene.
        measure: The error that counts.
        pool: What there is to choose from, one of `POOLS`.
        seed: Of the bootstrap.
    """
    where = standings(points, measure, seed)
    usable = [p for p in points if p.competes and p.batch == 1 and p.name in where and POOLS[pool](p)]
    steps = [Advice(0.0, "", "Nothing that was measured is as fast.")]
    best: Point | None = None
    for point in sorted(usable, key=lambda point: (point.milliseconds, where[point.name].mean)):
        if best is None or where[point.name].mean < where[best.name].mean:
            best = point
            steps.append(_advice(point, usable, where, measure))
    return steps


def error_unit(where: Mapping[str, Standing]) -> Unit:
    """The unit in which errors are printed."""
    return Unit.of(one.mean for one in where.values())


def _advice(point: Point, usable: Sequence[Point], where: Mapping[str, Standing], measure: str) -> Advice:
    rival, unit = _rival(point, usable, where), error_unit(where)
    instead = (
        "" if rival is None else f"; {_VERB[rival.kind]} there, {rival.name}, has {_error(where[rival.name], unit)}"
    )
    if point.exact:
        sentence = f"Run the simulator as it is ({point.milliseconds:.3g} ms per frame): it made these data."
    else:
        sentence = (
            f"{_DO[point.kind]} {point.name}: {describe_measure(measure)} {_error(where[point.name], unit)}, "
            f"{point.milliseconds:.3g} ms per frame{instead}."
        )
    return Advice(point.milliseconds, point.name, sentence)


_DO = {
    Kind.MODEL: "Use the emulator",
    Kind.GRAPH: "Use the graph network",
    Kind.SIMULATOR: "Run the",
    Kind.TRIVIAL: "Compute nothing: take",
}
_VERB = {Kind.MODEL: "the best emulator", Kind.SIMULATOR: "the best simulator setting", Kind.TRIVIAL: "the trivial"}
_OPPOSITE = {
    Kind.MODEL: (Kind.SIMULATOR,),
    Kind.GRAPH: (Kind.MODEL, Kind.SIMULATOR),
    Kind.SIMULATOR: (Kind.MODEL,),
    Kind.TRIVIAL: (Kind.MODEL, Kind.SIMULATOR),
}


def _rival(point: Point, usable: Sequence[Point], where: Mapping[str, Standing]) -> Point | None:
    """The most accurate point of the other kind within the same time."""
    others = [p for p in usable if p.kind in _OPPOSITE[point.kind] and p.milliseconds <= point.milliseconds]
    return min(others, key=lambda other: where[other.name].mean, default=None)


def _error(standing: Standing, unit: Unit) -> str:
    return f"{unit.show(standing.mean, 3)} ({unit.show(standing.low, 3)} to {unit.show(standing.high, 3)}){unit}"


@dataclass(frozen=True)
class Comparison:
    """A model against the simulator at equal time, or at equal error.

    Args:
        model: The model's name.
        at_equal_time: The most accurate simulator setting that is no slower, and its error over the model's.
        at_equal_error: The fastest simulator setting that is no less accurate, and its time over the model's.
    """

    model: str
    at_equal_time: tuple[str, float] | None
    at_equal_error: tuple[str, float] | None


def compare_with_simulator(points: Sequence[Point], measure: str) -> list[Comparison]:
    """Each model at batch 1 against the simulator's stable settings, in order of the models' errors."""
    known = [point for point in points if point.competes and math.isfinite(point.mean(measure))]
    simulators = [point for point in known if point.kind is Kind.SIMULATOR]
    models = [point for point in known if point.kind is Kind.MODEL and point.batch == 1]
    return [_compare(model, simulators, measure) for model in sorted(models, key=lambda model: model.mean(measure))]


def _compare(model: Point, simulators: Sequence[Point], measure: str) -> Comparison:
    error = model.mean(measure)
    as_fast = [point for point in simulators if point.milliseconds <= model.milliseconds]
    as_good = [point for point in simulators if point.mean(measure) <= error]
    rival = min(as_fast, key=lambda point: point.mean(measure), default=None)
    equal = min(as_good, key=lambda point: point.milliseconds, default=None)
    return Comparison(
        model.name,
        None if rival is None else (rival.name, rival.mean(measure) / error),
        None if equal is None else (equal.name, equal.milliseconds / model.milliseconds),
    )
