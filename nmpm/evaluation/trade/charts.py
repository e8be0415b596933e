"""The trade as pictures: error against time, error against frames, and the first scene beside its predictions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import Bbox

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.bootstrap import Floats
from nmpm.evaluation.trade.choices import Kind
from nmpm.evaluation.trade.ranking import Point, Rank, rank
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.evaluation.trade.sweep import OTHER_SCENES
from nmpm.viz.output import PictureStyle
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
_MOST_NAMES = 10
_Spot = tuple[tuple[float, float], str, str]
_SPOTS: Sequence[_Spot] = [
    ((x * away, y * away), {1: "left", 0: "center", -1: "right"}[x], {1: "bottom", 0: "center", -1: "top"}[y])
    for away in (9, 18, 32, 50)
    for x, y in ((1, 1), (-1, -1), (0, 1), (0, -1), (-1, 1), (1, -1), (1, 0), (-1, 0))
]
"""Where a name may be beside its point, in points of type, and which of its sides is there; the best first."""
_LINE_SPOTS: Sequence[_Spot] = [((x, 2), "left", "bottom") for x in (4, 90, 180, 270)]
_PANEL = 420  # pixels of a square panel's side


def draw_styled_chart(path: Path, points: Sequence[Point], scenes: Scenes, style: PictureStyle) -> None:
    """Write the chart of `draw_chart` as large and with letters as a talk or a paper needs."""
    with mpl.rc_context({"font.size": style.font_size}):
        draw_chart(path, points, scenes, style.size)


def draw_chart(path: Path, points: Sequence[Point], scenes: Scenes, size: tuple[float, float] = (9.0, 5.8)) -> None:
    """Write a picture, in the format of its suffix: emulators and simulator settings as points, the others as lines.

    Points have bootstrap intervals. Those that predict several scenes at once are left out, as are unstable ones. Rings
    mark the Pareto set, and a line connects it.
    """
    ranks = rank(points)
    shown = [p for p in points if p.stable and p.batch == 1 and p.name in ranks and math.isfinite(p.milliseconds)]
    measured = [p for p in shown if p.kind not in (Kind.TRIVIAL, Kind.FLOOR)]
    lines = [p for p in shown if p not in measured and ranks[p.name].mean > 0]
    least = min((ranks[p.name].low for p in measured if ranks[p.name].low > 0), default=0.0)
    near = [p for p in lines if ranks[p.name].mean > least / _FAR]
    far = "; ".join(f"{p.name}: {ranks[p.name].mean:.1g}" for p in lines if p not in near)

    figure = _figure(*size)
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
    _draw_frontier(axes, measured, ranks)
    machine = f"; {shown[0].times.hardware}, 1 thread, {shown[0].times.clock}" if shown else ""
    axes.set(xlabel=f"milliseconds per frame, one scene at a time{machine}", ylabel="MSE of the full rollout")
    below = f"\n(below the picture: {far})" if far else ""
    axes.set_title(f"{scenes.name}: time and error on {len(scenes)} test scenes{below}")
    if marked:
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
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


def _draw_frontier(axes: Any, measured: Sequence[Point], ranks: Mapping[str, Rank]) -> None:
    """A line through the Pareto set, and an arrow to where better points would be."""
    members = sorted((p for p in measured if ranks[p.name].member), key=lambda p: p.milliseconds)
    errors = [ranks[p.name].mean for p in members if not p.exact]
    if errors:  # an exact one is at the end of the line, which goes on below the picture there
        errors += [errors[-1]] * (len(members) - len(errors))
        times = [p.milliseconds for p in members]
        axes.plot(times, errors, drawstyle="steps-post", color="0.6", lw=1.2, zorder=1, label="frontier")
    arrow = {"arrowstyle": "-|>", "color": "0.35", "lw": 1.2}
    axes.annotate("better", (0.01, 0.015), (0.06, 0.08), "axes fraction", color="0.35", arrowprops=arrow)


def _write_names(axes: Any, marked: Sequence[Point], lines: Sequence[Point], ranks: Mapping[str, Rank]) -> None:
    """Names of at most `_MOST_NAMES` points and lines, where nothing else is.

    The Pareto set comes first, then lines, then the best others of each kind in turn.
    """
    axes.figure.draw_without_rendering()
    left, inside = axes.get_xlim()[0], axes.get_window_extent()
    taken = [_text_box(text) for text in axes.texts]
    places = axes.transData.transform([(p.milliseconds, ranks[p.name].mean) for p in marked]) if marked else ()
    taken += [Bbox.from_extents(*at, *at).padded(5) for at in places]
    best = sorted(marked, key=lambda p: (-ranks[p.name].probability, ranks[p.name].mean))
    members = [p for p in best if ranks[p.name].member]
    others = {kind: [p for p in best if p.kind is kind and p not in members] for kind in Kind}
    in_turn = [p for row in zip_longest(*others.values()) for p in row if p is not None]
    for p in [*members, *lines, *in_turn][:_MOST_NAMES]:
        is_line = p.kind in (Kind.TRIVIAL, Kind.FLOOR)
        at = (left if is_line else p.milliseconds, ranks[p.name].mean)
        colour = _LINES[p.kind]["color"] if is_line else _MARKERS[p.kind, p.of_other_scenes]["color"]
        for offset, side, level in _LINE_SPOTS if is_line else _SPOTS:
            text = axes.annotate(
                _short_name(p), at, offset, textcoords="offset points", ha=side, va=level, color=colour,
                fontsize="small", arrowprops=None if is_line else {"arrowstyle": "-", "color": "0.7", "lw": 0.6},
            )  # fmt: skip
            box = _text_box(text)
            if np.array_equal(Bbox.union([inside, box]), inside) and not box.count_overlaps(taken):
                taken.append(box)
                break
            text.remove()


def _text_box(text: Any) -> Any:
    """The box of an annotation's letters in pixels, without its arrow."""
    text.update_positions(text.figure.canvas.get_renderer())
    return Text.get_window_extent(text)


def _short_name(point: Point) -> str:
    short = point.name.removeprefix("simulator, ").replace(OTHER_SCENES, "")
    return short.replace(" resolution", "").replace("bfloat16", "bf16")


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
    if drawn:
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
        figure.savefig(part, format=path.suffix[1:])
