"""The trade as pictures: error against time, error against frames, and the first scene beside its predictions."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from adjustText import adjust_text
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from nmpm._support.atomic import atomic_write
from nmpm._support.messages import counted
from nmpm.evaluation.bootstrap import Floats
from nmpm.evaluation.trade.choices import Kind
from nmpm.evaluation.trade.models import OTHER_SCENES
from nmpm.evaluation.trade.ranking import Point, Rank, rank
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.viz.panel import PanelRenderer
from nmpm.viz.trajectories import LabelledTrajectories

_MARKERS: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.MODEL: {"marker": "o", "color": "#2670c8", "label": "emulator"},
        Kind.OTHER: {"marker": "^", "color": "#8a4ab0", "label": "other predictor"},
        Kind.SIMULATOR: {"marker": "s", "color": "#c8642a", "markerfacecolor": "none", "label": "simulator"},
    }
)
_OTHER_SCENES: Mapping[str, Any] = MappingProxyType(
    _MARKERS[Kind.MODEL] | {"markerfacecolor": "none", "label": "emulator of other scenes"}
)
_LINES: Mapping[Kind, dict[str, Any]] = MappingProxyType(
    {
        Kind.MODEL: {"lw": 1.6},
        Kind.OTHER: {"lw": 1.6, "linestyle": "-."},
        Kind.TRIVIAL: {"lw": 1.0, "linestyle": "--", "color": "0.45"},
        Kind.FLOOR: {"lw": 1.0, "linestyle": ":", "color": "#3a8a4a"},
    }
)
_FAR = 100  # a line further below all points than this factor is named in the title, not drawn
_MOVES = 300  # of the names that are in each other's way
_PANEL = 420  # pixels of a square panel's side
_DPI = 130


def draw_chart(path: Path, points: Sequence[Point], scenes: Scenes) -> None:
    """Write a PNG: emulators and simulator settings as points with bootstrap intervals, the others as lines.

    Points that predict several scenes at once are left out, as are unstable ones. Rings mark the Pareto set.
    """
    ranks = rank(points)
    shown = [p for p in points if p.stable and p.batch == 1 and p.name in ranks and math.isfinite(p.milliseconds)]
    marked = sorted((p for p in shown if p.kind in _MARKERS and not p.exact), key=_legend_order)
    lines = [p for p in shown if p.kind not in _MARKERS and ranks[p.name].mean > 0]
    least = min((ranks[p.name].low for p in shown if p.kind in _MARKERS and ranks[p.name].low > 0), default=0.0)
    near = [p for p in lines if ranks[p.name].mean > least / _FAR]
    far = "; ".join(f"{p.name}: {ranks[p.name].mean:.1g}" for p in lines if p not in near)

    figure = _figure(9, 5.8)
    axes = figure.subplots()
    for style, group in itertools.groupby(marked, key=_style):
        _draw_points(axes, list(group), ranks, style)
    for point in near:
        axes.axhline(ranks[point.name].mean, **_LINES[point.kind])
    for point in shown:
        if point.exact and point.kind is Kind.SIMULATOR:  # a logarithmic axis cannot show an error of 0
            axes.axvline(point.milliseconds, color=_MARKERS[point.kind]["color"], lw=1, label="simulator as shipped")
    _describe(axes, shown)
    below = f"\n(below the picture: {far})" if far else ""
    axes.set_title(f"{scenes.name}: time and error on {len(scenes)} test scenes{below}")
    if marked:
        figure.legend(loc="outside lower center", ncols=len(_MARKERS) + 2, frameon=False)
    _write_names(axes, marked, near, ranks)
    _save(figure, path)


def _legend_order(point: Point) -> tuple[int, bool]:
    return list(_MARKERS).index(point.kind), point.of_other_scenes


def _style(point: Point) -> Mapping[str, Any]:
    return _OTHER_SCENES if point.of_other_scenes else _MARKERS[point.kind]


def _draw_points(axes: Any, points: Sequence[Point], ranks: Mapping[str, Rank], style: Mapping[str, Any]) -> None:
    """Means with bootstrap intervals and time quartiles; members of the Pareto set in a ring."""
    times = [point.milliseconds for point in points]
    means = [ranks[point.name].mean for point in points]
    ends = [(ranks[p.name].mean - ranks[p.name].low, ranks[p.name].high - ranks[p.name].mean) for p in points]
    spread = [(p.milliseconds - p.quartiles[0], p.quartiles[2] - p.milliseconds) for p in points]
    lengths = {"yerr": np.transpose(ends), "xerr": np.transpose(spread)}
    axes.errorbar(times, means, **lengths, linestyle="none", ms=6, elinewidth=0.7, alpha=0.9, **style)
    members = [p for p in points if ranks[p.name].member]
    axes.plot(
        [p.milliseconds for p in members], [ranks[p.name].mean for p in members], linestyle="none", marker="o", ms=13,
        markerfacecolor="none", markeredgecolor="0.2", markeredgewidth=0.8,
    )  # fmt: skip


def _describe(axes: Any, shown: Sequence[Point]) -> None:
    """Logarithmic axes with names, and space beside the outermost points."""
    machine = ""
    if shown:
        times = shown[0].times
        machine = f"; {times.hardware}, {counted(shown[0].threads, 'thread')}, {times.clock}"
    axes.set(
        xscale="log", yscale="log", xlabel=f"milliseconds per frame, one scene at a time{machine}",
        ylabel="MSE of the full rollout",
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    milliseconds = [point.milliseconds for point in shown if point.kind in _MARKERS]
    if milliseconds:
        axes.set_xlim(min(milliseconds) / 1.4, max(milliseconds) * 1.15)
    axes.grid(visible=True, which="major", color="0.9", lw=0.7)
    axes.set_axisbelow(True)


def _write_names(axes: Any, marked: Sequence[Point], lines: Sequence[Point], ranks: Mapping[str, Rank]) -> None:
    """Names beside points, joined to those that they had to leave, and above the left end of lines."""
    names = [  # spaces keep them off the markers
        axes.text(
            p.milliseconds, ranks[p.name].mean, f"   {_short(p)}   ", fontsize=7, va="center",
            color=_MARKERS[p.kind]["color"],
        )
        for p in marked
    ]  # fmt: skip
    left = axes.get_xlim()[0]
    texts = [
        axes.text(left, ranks[p.name].mean, f" {p.name}", fontsize=7.5, va="bottom", color=_LINES[p.kind]["color"])
        for p in lines
    ]
    if names:
        arrows = {"arrowstyle": "-", "color": "0.6", "lw": 0.6}
        adjust_text(names, ax=axes, objects=texts or None, iter_lim=_MOVES, arrowprops=arrows)


def _short(point: Point) -> str:
    shown = point.name.removeprefix("simulator, ").replace(OTHER_SCENES, "")
    return shown.replace(" resolution", "").replace("bfloat16", "bf16")


def draw_curves(path: Path, points: Sequence[Point], scenes: Scenes) -> None:
    """Write a PNG: squared error of each frame, a mean over scenes, of all but the simulator's settings."""
    figure = _figure(7, 4)
    axes = figure.subplots()
    drawn: Counter[Kind] = Counter()
    for point in _first_forms(points):
        curve = 1e3 * point.curves.mean(0)
        if point.kind in _LINES and np.isfinite(curve).all():
            paler = 1 / (1 + drawn[point.kind]) if "color" in _LINES[point.kind] else 1.0
            axes.plot(np.arange(1, len(curve) + 1), curve, label=point.name, alpha=paler, **_LINES[point.kind])
            drawn[point.kind] += 1
    axes.set(
        yscale="log", xlabel="predicted frame", ylabel="squared error × 10⁻³ (length²)",
        title=f"{scenes.name}: mean of {len(scenes)} test scenes",
    )  # fmt: skip
    axes.set_ylim(bottom=1e-3)
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.legend(frameon=False, fontsize="small")
    _save(figure, path)


def draw_frames(path: Path, points: Sequence[Point], scenes: Scenes) -> None:
    """Write a PNG: a column for the scene as it was made and one for each model, a row for each shown frame."""
    indices = scenes.shown_frames()
    columns: dict[str, Floats] = {"data": scenes.recordings[0].frames[2:][indices].numpy()}
    for point in _first_forms(points):
        if point.kind in (Kind.MODEL, Kind.OTHER) and point.frames is not None:
            columns[point.name] = point.frames
    (left, right), (low, high) = scenes.scene.domain[:2]
    width = max(_PANEL, round(_PANEL * ((right - left) / (high - low)) ** 0.5))
    panel = PanelRenderer(_trajectories(columns, scenes), width)
    figure = _figure(len(columns) * width / 200, len(indices) * panel.height / 200 + 0.3, dpi=200)
    grid = figure.subplots(len(indices), len(columns), squeeze=False)
    for column, (name, frames) in zip(grid.T, columns.items(), strict=True):
        column[0].set_title(name, fontsize=8)
        for axes, frame, position in zip(column, indices, frames, strict=True):
            axes.imshow(panel.draw(position))
            axes.set(xticks=[], yticks=[])
            axes.set_ylabel(f"frame {frame + 2}" if axes in grid[:, 0] else "", fontsize=8)
            axes.spines[:].set_visible(False)
    _save(figure, path)


def _first_forms(points: Sequence[Point]) -> list[Point]:
    """The points without the further forms of each model."""
    first = {point.settings.get("model") if point.kind is Kind.MODEL else point.name: point for point in points[::-1]}
    return list(first.values())[::-1]


def _trajectories(columns: Mapping[str, Floats], scenes: Scenes) -> LabelledTrajectories:
    first = scenes.recordings[0]
    obstacle = first.obstacle.numpy() if len(first.obstacle) else None
    material, gravity = first.material.numpy(), first.gravity.tolist()
    return LabelledTrajectories.from_scene(scenes.scene, columns, material, obstacle, gravity=gravity)


def _figure(width: float, height: float, dpi: int = _DPI) -> Figure:
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as part:
        figure.savefig(part, format="png")
