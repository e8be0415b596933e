"""Snapshots: one column per frame, one row per trajectory, and a chart of the error against time below them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nmpm.errors import ConfigError
from nmpm.viz.camera import fit_camera
from nmpm.viz.colours import FAINT_TEXT, TEXT, Rgb, hex_code, material_colours
from nmpm.viz.output import check_output, check_suffix, replace_picture
from nmpm.viz.panel import PanelRenderer, format_out_of_view, format_time
from nmpm.viz.trajectories import LabelledTrajectories

SUFFIXES = (".png",)
DPI = 200
FONT_SIZE = 8.0
LABEL_LETTER = 18
"""Largest width of a letter of a row's label in pixels."""
PANEL_SIDE = 330
"""Side of a square panel in pixels; other shapes have the same area, within limits."""
LINE_COLOURS = ("#c8442c", "#3a5fa8", "#5b7f2b", "#7a4fa0")


@dataclass(frozen=True)
class _Layout:
    """Positions from the top left corner of the figure, and lengths, all in pixels."""

    columns: int
    rows: int
    panel_width: int
    panel_height: int
    chart_height: int
    header_height: int
    row_height: int
    left_margin: int = 96
    right_margin: int = 34
    titles_height: int = 58
    gap: int = 12

    @property
    def width(self) -> int:
        return self.left_margin + self.columns * (self.panel_width + self.gap) - self.gap + self.right_margin

    @property
    def height(self) -> int:
        return self.chart_top + (self.chart_height + 80 if self.chart_height else 12)

    @property
    def panels_top(self) -> int:
        return self.header_height + self.titles_height

    @property
    def chart_top(self) -> int:
        return self.panels_top + self.rows * (self.row_height + self.gap) + (58 if self.chart_height else 0)

    def corner(self, row: int, column: int) -> tuple[int, int]:
        """Left and upper edge of a panel."""
        return (
            self.left_margin + column * (self.panel_width + self.gap),
            self.panels_top + row * (self.row_height + self.gap) + (self.row_height - self.panel_height) // 2,
        )


def write_snapshots(trajectories: LabelledTrajectories, path: Path | str, columns: int = 6) -> Path:
    """Writes a picture of a few frames, evenly spaced from the first to the last.

    The rows are in the order of the trajectories. With at least two of them, a chart below shows the root mean square
    position error of each later one against the first.

    Args:
        trajectories: What to draw.
        path: A `.png` file; an existing one is replaced only when the new one is complete.
        columns: Number of frames to draw; fewer if the trajectories are shorter.

    Returns:
        The path.

    Raises:
        ConfigError: if the suffix is not supported or columns is below 1.
        DataError: if the file cannot be written; a missing or read-only folder is found before drawing.
    """
    path = Path(path)
    check_suffix(path, SUFFIXES, "snapshots")
    if columns < 1:
        raise ConfigError(f"Snapshots need at least one column; columns = {columns}.")
    check_output(path)
    frames = trajectories.evenly_spaced_frames(columns)
    style = {"font.family": "DejaVu Sans", "font.size": FONT_SIZE, "axes.linewidth": 0.6}
    with mpl.rc_context(style), replace_picture(path) as temporary:
        _build_figure(trajectories, frames).savefig(temporary, dpi=DPI, format="png")
    return path


def _build_figure(trajectories: LabelledTrajectories, frames: list[int]) -> Figure:
    panel = PanelRenderer(trajectories, _panel_width(trajectories))
    has_header = bool(trajectories.title) or len(trajectories.materials) > 1
    layout = _Layout(
        columns=len(frames),
        rows=len(trajectories.positions),
        panel_width=panel.width,
        panel_height=panel.height,
        row_height=max(panel.height, LABEL_LETTER * max(map(len, trajectories.positions))),
        chart_height=190 if len(trajectories.positions) > 1 and trajectories.frame_count > 1 else 0,
        header_height=52 if has_header else 6,
    )
    figure = Figure(figsize=(layout.width / DPI, layout.height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    _draw_panels(figure, layout, panel, frames)
    _draw_labels(figure, layout, trajectories, frames)
    if has_header:
        _draw_header(figure, layout, trajectories)
    if layout.chart_height:
        _draw_chart(figure, layout, trajectories, frames)
    return figure


def _panel_width(trajectories: LabelledTrajectories) -> int:
    camera = fit_camera(trajectories)
    return round(PANEL_SIDE * float(np.clip(math.sqrt(camera.width / camera.height), 0.6, 1.4)))


def _draw_panels(figure: Figure, layout: _Layout, panel: PanelRenderer, frames: list[int]) -> None:
    for row, position in enumerate(panel.trajectories.positions.values()):
        for column, frame in enumerate(frames):
            left, top = layout.corner(row, column)
            # Unlike an image in axes, this is not resampled.
            figure.figimage(panel.draw(position[frame]), left, layout.height - top - layout.panel_height)
            outside = panel.count_outside(position[frame])
            if outside:
                box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1.0}
                text = format_out_of_view(outside)
                _text(figure, layout, left + 14, top + 14, text, ha="left", va="top", size=FONT_SIZE - 2, bbox=box)


def _draw_labels(figure: Figure, layout: _Layout, trajectories: LabelledTrajectories, frames: list[int]) -> None:
    write, left, top = partial(_text, figure, layout), layout.left_margin, layout.panels_top
    for column, frame in enumerate(frames):
        middle, time = layout.corner(0, column)[0] + layout.panel_width / 2, format_time(trajectories, frame)
        write(middle, top - 27, f"frame {frame}", ha="center", va="bottom", weight="bold")
        write(middle, top - 4, time, FAINT_TEXT, ha="center", va="bottom")
    for row, label in enumerate(trajectories.positions):
        middle = layout.corner(row, 0)[1] + layout.panel_height / 2
        write(left - 14, middle, label, ha="right", va="center", weight="bold", rotation=90)


def _draw_header(figure: Figure, layout: _Layout, trajectories: LabelledTrajectories) -> None:
    title, size = trajectories.title, FONT_SIZE + 1.5
    _text(figure, layout, layout.left_margin, 16, title, ha="left", va="top", weight="bold", size=size)
    if len(trajectories.materials) < 2:
        return
    colours = material_colours(trajectories.materials)
    dot = partial(Line2D, [], [], ls="", marker="o", ms=5)
    dots = [dot(color=hex_code(colour), label=name) for name, colour in colours.items()]
    figure.legend(
        handles=dots,
        loc="upper right",
        bbox_to_anchor=(1 - layout.right_margin / layout.width, 1 - 8 / layout.height),
        ncols=len(dots),
        frameon=False,
        borderaxespad=0,
        borderpad=0.2,
        handletextpad=0.1,
        columnspacing=1.4,
    )


def _draw_chart(figure: Figure, layout: _Layout, trajectories: LabelledTrajectories, frames: list[int]) -> None:
    width = layout.width - layout.left_margin - layout.right_margin
    bottom = layout.height - layout.chart_top - layout.chart_height
    axes: Axes = figure.add_axes(
        (
            layout.left_margin / layout.width,
            bottom / layout.height,
            width / layout.width,
            layout.chart_height / layout.height,
        )
    )
    reference, *_ = trajectories.positions
    errors = trajectories.rms_errors()
    for (label, error), line in zip(errors.items(), LINE_COLOURS * len(errors), strict=False):
        axes.plot(error, color=line, lw=1.3, label=f"{label} against {reference}")
    axes.set_xlim(0, trajectories.frame_count - 1)
    largest = max(1e-12, *(float(error.max()) for error in errors.values()))
    # A prediction with a larger error has left the box; showing all of it would flatten the rest of the curve.
    diagonal = math.dist(*zip(*trajectories.outer_bounds, strict=True))
    axes.set_ylim(0, min(1.08 * largest, diagonal))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter("{x:g}")
    for frame in frames:
        axes.axvline(frame, color=hex_code(FAINT_TEXT), lw=0.5, alpha=0.45, zorder=0)
    _label_chart(axes, errors)
    title = "RMS position error (domain length" + ("; cut at the box's diagonal)" if largest > diagonal else ")")
    _text(figure, layout, layout.left_margin, layout.chart_top - 12, title, ha="left", va="bottom", weight="bold")


def _label_chart(axes: Axes, errors: Mapping[str, object]) -> None:
    axes.set_xlabel("frame", labelpad=2)
    axes.tick_params(length=2.5, width=0.6, labelsize=FONT_SIZE - 1, colors=hex_code(TEXT))
    axes.spines[["top", "right"]].set_visible(False)
    if len(errors) > 1:
        axes.legend(frameon=False, loc="upper left", fontsize=FONT_SIZE - 1)


def _text(
    figure: Figure,
    layout: _Layout,
    right: float,
    down: float,
    text: str,
    colour: Rgb = TEXT,
    **style: Any,
) -> None:
    figure.text(right / layout.width, 1 - down / layout.height, text, color=hex_code(colour), **style)
