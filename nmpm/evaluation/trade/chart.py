"""The trade as a picture: error against time, both logarithmic; kinds differ in marker, filling and colour."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm._support.messages import counted
from nmpm.evaluation.trade.choice import OTHER_SCENES, Kind
from nmpm.evaluation.trade.frontier import Standing, describe_measure, standings
from nmpm.evaluation.trade.labels import Box, boxes_along, boxes_around, choose_boxes
from nmpm.evaluation.trade.points import Point
from nmpm.evaluation.trade.scenes import Scenes

_MARKERS: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.MODEL: {"marker": "o", "color": "#2670c8", "label": "emulator"},
        Kind.GRAPH: {"marker": "^", "color": "#8a4ab0", "label": "graph network"},
        Kind.SIMULATOR: {"marker": "s", "color": "#c8642a", "markerfacecolor": "none", "label": "simulator"},
    }
)
_OTHER_SCENES: Mapping[str, Any] = MappingProxyType(
    _MARKERS[Kind.MODEL] | {"markerfacecolor": "none", "label": "emulator of other scenes"}
)
_DPI = 130  # names are measured at the resolution of the file: glyphs have whole pixels
_MARK = 13  # half of a marker with its ring, pixels
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

    where = standings(points, measure)
    shown = [p for p in points if p.stable and p.batch == 1 and p.name in where and math.isfinite(p.milliseconds)]
    marked = [p for p in shown if p.kind in _MARKERS and not p.exact]
    lines = [p for p in shown if p.kind in _LINES and where[p.name].mean > 0]
    least = min((where[p.name].low for p in shown if p.kind in _MARKERS and where[p.name].low > 0), default=0.0)
    near = [p for p in lines if where[p.name].mean > least / _FAR]
    far = "; ".join(f"{p.name}: {where[p.name].mean:.1g}" for p in lines if p not in near)

    figure = Figure(figsize=(9, 5.8), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    for style, group in itertools.groupby(sorted(marked, key=_rank), key=_style):
        _draw_points(axes, list(group), where, style)
    for point in near:
        axes.axhline(where[point.name].mean, lw=1, **_LINES[point.kind])
    exact = [_draw_exact(axes, p) for p in shown if p.exact and p.kind is Kind.SIMULATOR]
    _describe(axes, shown, measure)
    below = f"\n(below the picture: {far})" if far else ""
    axes.set_title(f"{scenes.name}: time and error on {len(scenes)} test scenes{below}")
    if marked:
        figure.legend(loc="outside lower center", ncols=len(_MARKERS) + 1, frameon=False)
    figure.draw_without_rendering()  # decides where the axes are, which names depend on
    _write_names(axes, marked, near, where, exact)
    with atomic_write(path) as part:
        figure.savefig(part, format="png")


def _rank(point: Point) -> tuple[int, bool]:
    """Order of the kinds in the legend; models of other scenes come after those of these scenes."""
    return list(_MARKERS).index(point.kind), point.of_other_scenes


def _style(point: Point) -> Mapping[str, Any]:
    return _OTHER_SCENES if point.of_other_scenes else _MARKERS[point.kind]


def _draw_points(axes: Any, points: Sequence[Point], where: Mapping[str, Standing], style: Mapping[str, Any]) -> None:
    """Means with bootstrap intervals and time quartiles; members of the Pareto set in a ring."""
    times = [point.milliseconds for point in points]
    means = [where[point.name].mean for point in points]
    ends = [(where[p.name].mean - where[p.name].low, where[p.name].high - where[p.name].mean) for p in points]
    spread = [(p.milliseconds - p.quartiles[0], p.quartiles[2] - p.milliseconds) for p in points]
    lengths = {"yerr": np.transpose(ends), "xerr": np.transpose(spread)}
    axes.errorbar(times, means, **lengths, linestyle="none", ms=6, elinewidth=0.7, alpha=0.9, **style)
    members = [p for p in points if where[p.name].member]
    axes.plot(
        [p.milliseconds for p in members], [where[p.name].mean for p in members], linestyle="none", marker="o", ms=13,
        markerfacecolor="none", markeredgecolor="0.2", markeredgewidth=0.8,
    )  # fmt: skip


def _draw_exact(axes: Any, point: Point) -> Any:
    """A vertical line, as a logarithmic axis has no place for an error of 0; returns its text."""
    colour = _MARKERS[point.kind]["color"]
    axes.axvline(point.milliseconds, color=colour, lw=1)
    return axes.annotate(
        "simulator as shipped (error 0)", (point.milliseconds, 0.02), xycoords=("data", "axes fraction"),
        rotation=90, ha="right", va="bottom", fontsize=8, color=colour,
    )  # fmt: skip


def _describe(axes: Any, shown: Sequence[Point], measure: str) -> None:
    """Logarithmic axes with names, and room beside the outermost points."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    one = shown[0].times if shown else None
    machine = "" if one is None else f"; {one.hardware}, {counted(shown[0].threads, 'thread')}, {one.clock}"
    axes.set(
        xscale="log", yscale="log", xlabel=f"milliseconds per frame, one scene at a time{machine}",
        ylabel=describe_measure(measure),
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    times = [point.milliseconds for point in shown if point.kind in _MARKERS]
    if times:
        axes.set_xlim(min(times) / 1.4, max(times) * 1.15)
    axes.grid(visible=True, which="major", color="0.9", lw=0.7)
    axes.set_axisbelow(True)


def _write_names(
    axes: Any, marked: Sequence[Point], lines: Sequence[Point], where: Mapping[str, Standing], texts: Sequence[Any]
) -> None:
    """Names beside points and lines where they cover the least; distant ones are joined to their point."""
    inside = Box(*axes.get_window_extent().extents)
    spots = axes.transData.transform([(p.milliseconds, where[p.name].mean) for p in (*marked, *lines)]).tolist()
    beside, heights = spots[: len(marked)], [y for _, y in spots[len(marked) :]]
    names = [_write_name(axes, p, 7, _MARKERS[p.kind]["color"]) for p in marked]
    names += [_write_name(axes, p, 7.5, _LINES[p.kind]["color"]) for p in lines]
    sizes = [(extent.width, extent.height) for name in names for extent in [name.get_window_extent()]]
    candidates = [
        *(list(boxes_around(x, y, *size)) for (x, y), size in zip(beside, sizes, strict=False)),
        *(list(boxes_along(y, *size, inside)) for y, size in zip(heights, sizes[len(beside) :], strict=True)),
    ]
    taken = [Box(x - _MARK, y - _MARK, x + _MARK, y + _MARK) for x, y in beside]
    taken += [Box(*text.get_window_extent().extents) for text in texts]
    crossed = [Box(inside.left, y - 1, inside.right, y + 1) for y in heights]
    crossed += [bar for point in marked for bar in _error_bars(axes, point, where[point.name])]
    places = choose_boxes(candidates, taken, crossed, inside)
    for name, box in zip(names, places, strict=True):
        offset = (box.left - inside.left, box.bottom - inside.bottom)
        name.set_position([72 / axes.figure.dpi * pixels for pixels in offset])
    for (x, y), box, name in zip(beside, places, names, strict=False):
        _join(axes, x, y, box, name.get_color())


def _write_name(axes: Any, point: Point, size: float, colour: str) -> Any:
    """The text of a name in the axes' corner, to be moved by points."""
    return axes.annotate(
        _short(point), (0, 0), xycoords="axes fraction", xytext=(0, 0), textcoords="offset points", fontsize=size,
        color=colour,
    )  # fmt: skip


def _error_bars(axes: Any, point: Point, one: Standing) -> list[Box]:
    """The boxes of a point's error bars, three pixels wide."""
    ends = [(point.quartiles[0], one.mean), (point.quartiles[2], one.mean)]
    ends += [(point.milliseconds, max(one.low, axes.get_ylim()[0])), (point.milliseconds, one.high)]
    (left, y), (right, _), (x, bottom), (_, top) = axes.transData.transform(ends)
    return [Box(left, y - 1.5, right, y + 1.5), Box(x - 1.5, bottom, x + 1.5, top)]


def _join(axes: Any, x: float, y: float, box: Box, colour: str) -> None:
    """A dotted line from a point to its name, unless that is beside it; error bars are solid."""
    near = (min(max(x, box.left), box.right), min(max(y, box.bottom), box.top))
    if math.dist((x, y), near) > 1.5 * _MARK:
        ends = axes.transData.inverted().transform([(x, y), near])
        axes.plot(*ends.T, color=colour, lw=0.9, linestyle=":", scalex=False, scaley=False)


def _short(point: Point) -> str:
    shown = point.name.removeprefix("simulator, ").replace(OTHER_SCENES, "")
    return shown.replace(" resolution", "").replace("bfloat16", "bf16")
