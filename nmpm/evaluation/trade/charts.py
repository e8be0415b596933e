"""The trade as pictures: error against time, error against frames, and the first scene beside its predictions."""

from __future__ import annotations

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
from nmpm.evaluation.bootstrap import Floats
from nmpm.evaluation.trade.choices import Kind
from nmpm.evaluation.trade.ranking import Point, Rank, rank
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.sweep import OTHER_SCENES
from nmpm.viz.panel import PanelRenderer
from nmpm.viz.trajectories import LabelledTrajectories

_EMULATOR = {"marker": "o", "color": "#2670c8", "label": "emulator"}
_MARKERS: Mapping[tuple[Kind, bool], dict[str, Any]] = MappingProxyType(
    {
        (Kind.MODEL, False): _EMULATOR,
        (Kind.MODEL, True): _EMULATOR | {"markerfacecolor": "none", "label": "emulator of other scenes"},
        (Kind.OTHER, False): {"marker": "^", "color": "#8a4ab0", "label": "other predictor"},
        (Kind.SIMULATOR, False): {"marker": "s", "color": "#c8642a", "markerfacecolor": "none", "label": "simulator"},
    }
)
"""Styles by kind, and by whether it was trained on other scenes."""
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


def draw_chart(path: Path, points: Sequence[Point], scenes: Scenes) -> None:
    """Write a PNG: emulators and simulator settings as points with bootstrap intervals, the others as lines.

    Points that predict several scenes at once are left out, as are unstable ones. Rings mark the Pareto set.
    """
    ranks = rank(points)
    shown = [p for p in points if p.stable and p.batch == 1 and p.name in ranks and math.isfinite(p.milliseconds)]
    measured = [p for p in shown if p.kind not in (Kind.TRIVIAL, Kind.FLOOR)]
    lines = [p for p in shown if p not in measured and ranks[p.name].mean > 0]
    least = min((ranks[p.name].low for p in measured if ranks[p.name].low > 0), default=0.0)
    near = [p for p in lines if ranks[p.name].mean > least / _FAR]
    far = "; ".join(f"{p.name}: {ranks[p.name].mean:.1g}" for p in lines if p not in near)

    figure = _figure(9, 5.8)
    axes = figure.subplots()
    marked = [p for p in measured if not p.exact]
    for kind, style in _MARKERS.items():
        if group := [p for p in marked if (p.kind, p.of_other_scenes) == kind]:
            _draw_points(axes, group, ranks, style)
    for point in near:
        axes.axhline(ranks[point.name].mean, **_LINES[point.kind])
    for point in measured:
        if point.exact:  # a logarithmic axis cannot show an error of 0
            axes.axvline(point.milliseconds, color="#c8642a", lw=1, label="simulator as shipped")
    _scale(axes, measured)
    machine = f"; {shown[0].times.hardware}, 1 thread, {shown[0].times.clock}" if shown else ""
    axes.set(xlabel=f"milliseconds per frame, one scene at a time{machine}", ylabel="MSE of the full rollout")
    below = f"\n(below the picture: {far})" if far else ""
    axes.set_title(f"{scenes.name}: time and error on {len(scenes)} test scenes{below}")
    if marked:
        figure.legend(loc="outside lower center", ncols=len(_MARKERS) + 1, frameon=False)
    _write_names(axes, marked, near, ranks)
    _save(figure, path)


def _draw_points(axes: Any, points: Sequence[Point], ranks: Mapping[str, Rank], style: Mapping[str, Any]) -> None:
    """Means with bootstrap intervals and time quartiles; members of the Pareto set in a ring."""
    times = np.array([p.milliseconds for p in points])
    means = np.array([ranks[p.name].mean for p in points])
    bounds = np.transpose([(ranks[p.name].low, ranks[p.name].high) for p in points])
    quartiles = np.transpose([(p.quartiles[0], p.quartiles[2]) for p in points])
    lengths = {"xerr": np.abs(quartiles - times), "yerr": np.abs(bounds - means)}
    axes.errorbar(times, means, **lengths, linestyle="none", ms=6, elinewidth=0.7, alpha=0.9, **style)
    members = [ranks[p.name].member for p in points]
    ring = {"markerfacecolor": "none", "markeredgecolor": "0.2", "markeredgewidth": 0.8}
    axes.plot(times[members], means[members], linestyle="none", marker="o", ms=13, **ring)


def _scale(axes: Any, measured: Sequence[Point]) -> None:
    """Logarithmic axes, with space beside the outermost points."""
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
    if measured:
        milliseconds = [point.milliseconds for point in measured]
        axes.set_xlim(min(milliseconds) / 1.4, max(milliseconds) * 1.15)
    axes.grid(visible=True, which="major", color="0.9", lw=0.7)
    axes.set_axisbelow(True)


def _write_names(axes: Any, marked: Sequence[Point], lines: Sequence[Point], ranks: Mapping[str, Rank]) -> None:
    """Names beside points, joined to those that they had to leave, and above the left end of lines."""
    names = []
    for p in marked:
        short = p.name.removeprefix("simulator, ").replace(OTHER_SCENES, "")
        text = f"   {short.replace(' resolution', '').replace('bfloat16', 'bf16')}   "  # spaces keep it off the marker
        colour = _MARKERS[p.kind, p.of_other_scenes]["color"]
        names.append(axes.text(p.milliseconds, ranks[p.name].mean, text, fontsize=7, va="center", color=colour))
    left = axes.get_xlim()[0]
    texts = [
        axes.text(left, ranks[p.name].mean, f" {p.name}", fontsize=7.5, va="bottom", color=_LINES[p.kind]["color"])
        for p in lines
    ]
    if names:
        arrows = {"arrowstyle": "-", "color": "0.6", "lw": 0.6}
        adjust_text(names, ax=axes, objects=texts or None, iter_lim=_MOVES, arrowprops=arrows)


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
    first = scenes.recordings[0]
    obstacle = first.obstacle.numpy() if len(first.obstacle) else None
    material, gravity = first.material.numpy(), first.gravity.tolist()
    panel = PanelRenderer(
        LabelledTrajectories.from_scene(scenes.scene, columns, material, obstacle, gravity=gravity), width
    )
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


def _figure(width: float, height: float, dpi: int = 130) -> Figure:
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as part:
        figure.savefig(part, format="png")
