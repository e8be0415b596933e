"""Snapshots in time: one column per moment, one row per trajectory, and beneath them the error against time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nmpm._support.atomic import replacing
from nmpm.errors import ConfigError
from nmpm.viz.camera import camera_for
from nmpm.viz.captions import clock, unseen
from nmpm.viz.colours import FAINT_INK, INK, Rgb, css, palette
from nmpm.viz.exhibit import Exhibit
from nmpm.viz.output import check_suffix
from nmpm.viz.panel import Panel

SUFFIXES = (".png",)
DPI = 200
FONT = 8.0
LETTER = 18
"""Length of a letter of a row's label in pixels, at most."""
PANEL_SIDE = 330
"""Side of a square panel in pixels; other shapes cover the same area."""
LINE_COLOURS = ("#c8442c", "#3a5fa8", "#5b7f2b", "#7a4fa0")


@dataclass(frozen=True)
class _Layout:
    """Places in pixels from the figure's top left corner; lengths are in pixels too."""

    columns: int
    rows: int
    panel_width: int
    panel_height: int
    chart_height: int
    head: int
    row_height: int
    left: int = 96
    right: int = 34
    titles: int = 58
    gap: int = 12

    @property
    def width(self) -> int:
        return self.left + self.columns * (self.panel_width + self.gap) - self.gap + self.right

    @property
    def height(self) -> int:
        return self.chart_top + (self.chart_height + 80 if self.chart_height else 12)

    @property
    def panels_top(self) -> int:
        return self.head + self.titles

    @property
    def chart_top(self) -> int:
        return self.panels_top + self.rows * (self.row_height + self.gap) + (58 if self.chart_height else 0)

    def corner(self, row: int, column: int) -> tuple[int, int]:
        """Left and upper edge of a panel."""
        return (
            self.left + column * (self.panel_width + self.gap),
            self.panels_top + row * (self.row_height + self.gap) + (self.row_height - self.panel_height) // 2,
        )


def snapshots(exhibit: Exhibit, path: Path | str, columns: int = 6) -> Path:
    """Writes a picture of a few moments, evenly spread from the first frame to the last.

    Rows stand in the exhibit's order, so that a prediction lies under the truth. Where there are at least two rows, a
    chart beneath shows the root mean square position error of each later row against the first.

    Args:
        exhibit: What to draw.
        path: A `.png` file; replaced only once the new picture is whole.
        columns: Number of moments; fewer where there are fewer frames.

    Returns:
        The path.

    Raises:
        ConfigError: if the suffix is not supported or columns is below one.
    """
    path = Path(path)
    check_suffix(path, SUFFIXES, "snapshots")
    if columns < 1:
        raise ConfigError(f"Snapshots need at least one column; columns = {columns}.")
    style = {"font.family": "DejaVu Sans", "font.size": FONT, "axes.linewidth": 0.6}
    with mpl.rc_context(style), replacing(path) as temporary:
        _figure(exhibit, exhibit.spread(columns)).savefig(temporary, dpi=DPI, format="png")
    return path


def _figure(exhibit: Exhibit, moments: list[int]) -> Figure:
    panel = Panel(exhibit, _panel_width(exhibit))
    headed = bool(exhibit.title) or len(exhibit.materials) > 1
    layout = _Layout(
        columns=len(moments),
        rows=len(exhibit.rows),
        panel_width=panel.width,
        panel_height=panel.height,
        row_height=max(panel.height, LETTER * max(map(len, exhibit.rows))),
        chart_height=190 if len(exhibit.rows) > 1 and exhibit.frames > 1 else 0,
        head=52 if headed else 6,
    )
    figure = Figure(figsize=(layout.width / DPI, layout.height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _draw_panels(figure, layout, panel, moments)
    _write_labels(figure, layout, exhibit, moments)
    if headed:
        _write_head(figure, layout, exhibit)
    if layout.chart_height:
        _draw_chart(figure, layout, exhibit, moments)
    return figure


def _panel_width(exhibit: Exhibit) -> int:
    camera = camera_for(exhibit)
    return round(PANEL_SIDE * float(np.clip(math.sqrt(camera.width / camera.height), 0.6, 1.4)))


def _draw_panels(figure: Figure, layout: _Layout, panel: Panel, moments: list[int]) -> None:
    for row, position in enumerate(panel.exhibit.rows.values()):
        for column, frame in enumerate(moments):
            left, top = layout.corner(row, column)
            # Unlike an axes' image this lands pixel for pixel, without resampling.
            figure.figimage(panel.draw(position[frame]), left, layout.height - top - layout.panel_height)
            outside = panel.outside(position[frame])
            if outside:
                mark = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1.0}
                words = unseen(outside)
                _text(figure, layout, left + 14, top + 14, words, ha="left", va="top", size=FONT - 2, bbox=mark)


def _write_labels(figure: Figure, layout: _Layout, exhibit: Exhibit, moments: list[int]) -> None:
    for column, frame in enumerate(moments):
        middle = layout.corner(0, column)[0] + layout.panel_width / 2
        top = layout.panels_top
        _text(figure, layout, middle, top - 27, f"frame {frame}", ha="center", va="bottom", weight="bold")
        _text(figure, layout, middle, top - 4, clock(exhibit, frame), ha="center", va="bottom", ink=FAINT_INK)
    for row, label in enumerate(exhibit.rows):
        middle = layout.corner(row, 0)[1] + layout.panel_height / 2
        _text(figure, layout, layout.left - 14, middle, label, ha="right", va="center", weight="bold", rotation=90)


def _write_head(figure: Figure, layout: _Layout, exhibit: Exhibit) -> None:
    _text(figure, layout, layout.left, 16, exhibit.title, ha="left", va="top", weight="bold", size=FONT + 1.5)
    if len(exhibit.materials) < 2:
        return
    chosen = palette(exhibit.materials)
    dots = [Line2D([], [], ls="", marker="o", ms=5, color=css(ink), label=name) for name, ink in chosen.items()]
    figure.legend(
        handles=dots,
        loc="upper right",
        bbox_to_anchor=(1 - layout.right / layout.width, 1 - 8 / layout.height),
        ncols=len(dots),
        frameon=False,
        borderaxespad=0,
        borderpad=0.2,
        handletextpad=0.1,
        columnspacing=1.4,
    )


def _draw_chart(figure: Figure, layout: _Layout, exhibit: Exhibit, moments: list[int]) -> None:
    width = layout.width - layout.left - layout.right
    bottom = layout.height - layout.chart_top - layout.chart_height
    axes: Axes = figure.add_axes(
        (
            layout.left / layout.width,
            bottom / layout.height,
            width / layout.width,
            layout.chart_height / layout.height,
        )
    )
    reference, *_ = exhibit.rows
    errors = exhibit.errors()
    for (label, error), line in zip(errors.items(), LINE_COLOURS * len(errors), strict=False):
        axes.plot(error, color=line, lw=1.3, label=f"{label} against {reference}")
    axes.set_xlim(0, exhibit.frames - 1)
    largest = max(1e-12, *(float(error.max()) for error in errors.values()))
    # Beyond the box's diagonal a prediction has left the box, and how far would only flatten the rest of the curve.
    diagonal = math.dist(*zip(*exhibit.walls, strict=True))
    axes.set_ylim(0, min(1.08 * largest, diagonal))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter("{x:g}")
    for frame in moments:
        axes.axvline(frame, color=css(FAINT_INK), lw=0.5, alpha=0.45, zorder=0)
    _label_chart(axes, errors)
    title = "RMS position error (domain length" + ("; cut at the box's diagonal)" if largest > diagonal else ")")
    _text(figure, layout, layout.left, layout.chart_top - 12, title, ha="left", va="bottom", weight="bold")


def _label_chart(axes: Axes, errors: Mapping[str, object]) -> None:
    axes.set_xlabel("frame", labelpad=2)
    axes.tick_params(length=2.5, width=0.6, labelsize=FONT - 1, colors=css(INK))
    axes.spines[["top", "right"]].set_visible(False)
    if len(errors) > 1:
        axes.legend(frameon=False, loc="upper left", fontsize=FONT - 1)


def _text(
    figure: Figure,
    layout: _Layout,
    right: float,
    down: float,
    text: str,
    ink: Rgb = INK,
    **style: Any,
) -> None:
    figure.text(right / layout.width, 1 - down / layout.height, text, color=css(ink), **style)
