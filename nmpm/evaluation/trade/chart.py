"""The trade as a picture: error against time, both logarithmic; kinds differ in marker, filling and colour."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.trade.choice import Kind
from nmpm.evaluation.trade.frontier import Standing, describe_measure, standings
from nmpm.evaluation.trade.points import Point
from nmpm.evaluation.trade.scenes import Scenes

_MARKERS: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.MODEL: {"marker": "o", "color": "#2670c8", "label": "emulator"},
        Kind.GRAPH: {"marker": "^", "color": "#8a4ab0", "label": "graph network"},
        Kind.SIMULATOR: {"marker": "s", "color": "#c8642a", "markerfacecolor": "none", "label": "simulator"},
    }
)
_PLACES: Mapping[Kind, Sequence[dict[str, Any]]] = MappingProxyType(  # of names, in turn, in points
    {
        Kind.MODEL: ({"xytext": (-8, -11), "ha": "right"}, {"xytext": (8, -11)}),
        Kind.GRAPH: ({"xytext": (-8, 6), "ha": "right"},),
        Kind.SIMULATOR: ({"xytext": (8, 5)},),
    }
)
_SIDES = ((0.9, "right"), (0.005, "left"))  # of the lines' names, in turn, as a share of the width
_FAR = 100  # a line further below all points than this factor is named in the title, not drawn
_LINES: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.TRIVIAL: {"linestyle": "--", "color": "0.45"},
        Kind.FLOOR: {"linestyle": ":", "color": "#3a8a4a"},
    }
)


def draw_chart(path: Path, points: Sequence[Point], scenes: Scenes, measure: str = "mse") -> None:
    """Write a PNG: emulators and simulator settings as points with bootstrap intervals, the others as lines.

    Points that predict several scenes at once are left out, as are unstable ones. Rings mark the Pareto set.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    where = standings(points, measure)
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axes = figure.subplots()
    shown = [p for p in points if p.stable and p.batch == 1 and p.name in where and math.isfinite(p.milliseconds)]
    for kind, style in _MARKERS.items():
        _draw_points(axes, [p for p in shown if p.kind is kind and not p.exact], where, style)
    lines = [p for p in shown if p.kind in _LINES and where[p.name].mean > 0]
    least = min((where[p.name].low for p in shown if p.kind in _MARKERS and where[p.name].low > 0), default=0.0)
    near = [p for p in lines if where[p.name].mean > least / _FAR]
    for point, side in zip(near, cycle(_SIDES), strict=False):
        _draw_line(axes, point, where[point.name], _LINES[point.kind], side)
    far = "; ".join(f"{p.name}: {where[p.name].mean:.1g}" for p in lines if p not in near)
    below = f"\n(below the picture: {far})" if far else ""
    for point in (p for p in shown if p.exact and p.kind is Kind.SIMULATOR):
        axes.axvline(point.milliseconds, color="#c8642a", lw=1)
        axes.annotate(
            "simulator as shipped (error 0)", (point.milliseconds, 0.5), xycoords=("data", "axes fraction"),
            rotation=90, ha="right", va="center", fontsize=8, color="#c8642a",
        )  # fmt: skip
    one = shown[0].times if shown else None
    machine = "" if one is None else f"; {one.hardware}, {shown[0].threads} thread, {one.clock}"
    axes.set(
        xscale="log", yscale="log", xlabel=f"milliseconds per frame, one scene at a time{machine}",
        ylabel=describe_measure(measure), title=f"{scenes.name}: time and error on {len(scenes)} test scenes" + below,
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    times = [point.milliseconds for point in shown if point.kind in _MARKERS]
    if times:  # room for names beside the outermost points
        axes.set_xlim(min(times) / 1.4, max(times) * 1.15)
    axes.grid(visible=True, which="major", color="0.9", lw=0.7)
    axes.set_axisbelow(True)
    axes.legend(loc="best", frameon=False)
    with atomic_write(path) as part:
        figure.savefig(part, dpi=130, format="png")


def _draw_points(axes: Any, points: Sequence[Point], where: Mapping[str, Standing], style: Mapping[str, Any]) -> None:
    """Means with bootstrap intervals and time quartiles, named; members of the Pareto set in a ring."""
    if not points:
        return
    ordered = sorted(points, key=lambda point: point.milliseconds)
    times = [point.milliseconds for point in ordered]
    means = [where[point.name].mean for point in ordered]
    ends = [(where[p.name].mean - where[p.name].low, where[p.name].high - where[p.name].mean) for p in ordered]
    spread = [(p.milliseconds - p.quartiles[0], p.quartiles[2] - p.milliseconds) for p in ordered]
    lengths = {"yerr": np.transpose(ends), "xerr": np.transpose(spread)}
    axes.errorbar(times, means, **lengths, linestyle="none", ms=6, elinewidth=0.7, alpha=0.9, **style)
    members = [p for p in ordered if where[p.name].member]
    axes.plot(
        [p.milliseconds for p in members], [where[p.name].mean for p in members], linestyle="none", marker="o", ms=13,
        markerfacecolor="none", markeredgecolor="0.2", markeredgewidth=0.8,
    )  # fmt: skip
    for point, time, mean, place in zip(ordered, times, means, cycle(_PLACES[ordered[0].kind]), strict=False):
        axes.annotate(
            _short(point), (time, mean), **place, textcoords="offset points", fontsize=7, color=style["color"]
        )


def _draw_line(axes: Any, point: Point, one: Standing, style: Mapping[str, Any], side: tuple[float, str]) -> None:
    axes.axhline(one.mean, lw=1, **style)
    axes.annotate(
        point.name, (side[0], one.mean), xycoords=("axes fraction", "data"), xytext=(0, 2),
        textcoords="offset points", fontsize=7.5, ha=side[1], color=style["color"],
    )  # fmt: skip


def _short(point: Point) -> str:
    return point.name.removeprefix("simulator, ").replace(" resolution", "").replace("bfloat16", "bf16")
