"""The trade as an interactive page: one HTML file without links, for any browser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from nmpm.evaluation.trade.accuracy import shown_frame, thumbnail
from nmpm.evaluation.trade.frontier import POOLS, advise, describe_measure, standings
from nmpm.evaluation.trade.points import Point, measure_names
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.viz.output import fill_page

_SCRIPTS = ("axes.js", "chart.js", "trade.js")


def page_text(points: Sequence[Point], scenes: Scenes) -> str:
    """The page's text; points without times are left out."""
    return fill_page(files(__package__) / "web", _SCRIPTS, describe_trade(points, scenes))


def describe_trade(points: Sequence[Point], scenes: Scenes) -> dict[str, Any]:
    """All that the page's scripts read, as JSON."""
    timed = [point for point in points if math.isfinite(point.milliseconds)]
    names = measure_names(timed)
    where = {name: standings(timed, name) for name in names}
    frame = shown_frame(scenes)
    return {
        "title": f"{scenes.name}: time and error",
        "scenes": len(scenes),
        "machine": _machine(timed),
        "measures": [{"name": name, "label": describe_measure(name)} for name in names],
        "pools": list(POOLS),
        "frame": frame + 2,
        "truth": thumbnail(scenes, scenes.recordings[0].frames[frame + 2]),
        "points": [
            _describe_point(point)
            | {"where": {name: _numbers(where[name][point.name]) for name in names if point.name in where[name]}}
            for point in timed
        ],
        "advice": {
            name: {
                pool: [[step.milliseconds, step.name, step.sentence] for step in advise(timed, name, pool)]
                for pool in POOLS
            }
            for name in names
        },
    }


def _machine(points: Sequence[Point]) -> str:
    if not points:
        return ""
    return f"{points[0].times.hardware}, {points[0].times.clock}"


def _describe_point(point: Point) -> dict[str, Any]:
    memory = point.times.memory
    facts = {
        **point.settings,
        "scenes at once": point.batch,
        "threads": point.threads,
        "device": point.device,
        "time per frame": f"{point.milliseconds:.3g} ms ({point.quartiles[0]:.3g} to {point.quartiles[2]:.3g})",
        "time per second of the scene": f"{point.milliseconds_per_second:.0f} ms",
        "frames per second": f"{point.frames_per_second:.0f}",
        "peak memory": "not known" if memory is None else f"{memory / 1e6:.3g} MB",
    }
    return {
        "name": point.name,
        "kind": point.kind.value,
        "facts": {key: str(value) for key, value in facts.items()},
        "batch": point.batch,
        "ms": [float(f"{value:.5g}") for value in point.quartiles],
        "exact": point.exact,
        "stable": point.stable,
        "failure": next(iter(point.failures.values()), ""),
        "failed": len(point.failures),
        "picture": point.picture,
    }


def _numbers(one: Any) -> list[float]:
    """Mean, interval, membership in the Pareto set and its probability."""
    return [*(float(f"{value:.5g}") for value in (one.mean, one.low, one.high)), int(one.member), one.probability]
