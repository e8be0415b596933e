"""Snapshots: one column per frame, one row per trajectory, and a chart of the error against time below them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nmpm.colours import FAINT_TEXT, TEXT, Rgb, hex_code, material_colours
from nmpm.errors import ConfigError
from nmpm.viz.camera import fit_camera
from nmpm.viz.charts import add_frame_axes, add_legend, draw_curves, legend_of_bands, legend_of_curves
from nmpm.viz.ensembles import quantity_curves
from nmpm.viz.output import check_output, replace_picture
from nmpm.viz.panel import PanelRenderer, format_time
from nmpm.viz.trajectories import LabelledTrajectories

DPI = 200
FONT_SIZE = 8.0
LINE_COLOURS = ("#c8442c", "#3a5fa8", "#5b7f2b", "#7a4fa0")

# Lengths in pixels.
PANEL_SIDE = 330  # of a square panel; other shapes have the same area, within limits
LABEL_LETTER = 18  # largest width of a letter of a row's label
LEFT, RIGHT, GAP = 96, 34, 12
TITLES, CHART, ABOVE_CHART, BELOW_CHART = 58, 190, 58, 80
CHART_WIDTH = 480  # smallest width of one of several charts, with its numbers
LEGENDS, LEGEND_WIDTH = 64, 640  # height of an ensemble's legends, and width of the first


def write_snapshots(trajectories: LabelledTrajectories, path: Path | str, columns: int = 6) -> Path:
    """Writes a picture of a few frames from the first to the last, between which particles move equally far.

    The rows are in the order of the trajectories. With at least two of them, a chart below shows the root mean square
    position error of each later one against the first. A member of an ensemble is drawn over the share of members that
    are at each place, and the charts show derived quantities with bands of the members.

    Args:
        trajectories: What to draw.
        path: A `.png`, `.svg` or `.pdf` file; an existing one is replaced only when the new one is complete.
        columns: Number of frames to draw; fewer if the trajectories are shorter.

    Returns:
        The path.

    Raises:
        ConfigError: if the suffix is not supported or columns is below 1.
        DataError: if the file cannot be written; a missing or read-only folder is found before drawing.
    """
    path = Path(path)
    if columns < 1:
        raise ConfigError(f"Snapshots need at least one column; columns = {columns}.")
    suffix = check_output(path, (".png", ".svg", ".pdf"))
    style = {"font.family": "DejaVu Sans", "font.size": FONT_SIZE, "axes.linewidth": 0.6}
    with mpl.rc_context(style), replace_picture(path) as temporary:
        _Snapshots(trajectories, columns).figure.savefig(temporary, dpi=DPI, format=suffix[1:])
    return path


class _Snapshots:
    """Draws the figure; positions are counted in pixels to the right and down from the upper left corner."""

    def __init__(self, trajectories: LabelledTrajectories, columns: int) -> None:
        self.trajectories = trajectories
        self.frames = trajectories.eventful_frames(columns)
        camera = fit_camera(trajectories)
        stretch = float(np.clip(math.sqrt(camera.width / camera.height), 0.6, 1.4))
        self.panel = PanelRenderer(trajectories, round(PANEL_SIDE * stretch))
        rows = len(trajectories.positions)
        self.members = trajectories.members
        has_header = trajectories.title or len(trajectories.materials) > 1
        has_chart = trajectories.frame_count > 1 and (rows > 1 or self.members)
        self.row_height = max(self.panel.height, LABEL_LETTER * max(map(len, trajectories.positions)))
        self.panels_top = TITLES + (52 if has_header else 6)
        self.panels_bottom = self.panels_top + rows * (self.row_height + GAP)
        self.width = LEFT + len(self.frames) * (self.panel.width + GAP) - GAP + RIGHT
        self.height = self.panels_bottom + (ABOVE_CHART + CHART + BELOW_CHART if has_chart else 12)
        self.height += LEGENDS if self.members else 0
        self.figure = Figure(figsize=(self.width / DPI, self.height / DPI), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        self._draw_panels()
        if has_header:
            self._draw_header()
        if self.members:
            self._draw_legends()
        if has_chart and self.members:
            self._draw_ensemble()
        elif has_chart:
            self._draw_errors()

    def _draw_panels(self) -> None:
        width, height = self.panel.width, self.panel.height
        lefts = [LEFT + column * (width + GAP) for column in range(len(self.frames))]
        for left, frame in zip(lefts, self.frames, strict=True):
            time = format_time(self.trajectories, frame)
            self._write(left + width / 2, self.panels_top - 27, f"frame {frame}", ha="center", weight="bold")
            self._write(left + width / 2, self.panels_top - 4, time, FAINT_TEXT, ha="center")
        for row, (label, position) in enumerate(self.trajectories.positions.items()):
            middle = self.panels_top + row * (self.row_height + GAP) + (self.row_height - height) // 2 + height / 2
            self._write(LEFT - 14, middle, label, ha="right", va="center", weight="bold", rotation=90)
            top = int(middle - height / 2)
            for left, frame in zip(lefts, self.frames, strict=True):
                members = [member[frame] for member in self.members.values()] if label in self.members else []
                # Unlike an image in axes, this is not resampled.
                self.figure.figimage(self.panel.draw(position[frame], members), left, self.height - top - height)
                if outside := self.panel.count_outside(position[frame]):
                    box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1.0}
                    text = f"{outside} out of view"
                    self._write(left + 14, top + 14, text, va="top", size=FONT_SIZE - 2, bbox=box)

    def _draw_header(self) -> None:
        """The title, and a legend where there are several materials."""
        self._write(LEFT, 16, self.trajectories.title, va="top", weight="bold", size=FONT_SIZE + 1.5)
        colours = material_colours(self.trajectories.materials)
        if len(colours) < 2:
            return
        self.figure.legend(
            handles=[
                Line2D([], [], ls="", marker="o", ms=5, color=hex_code(colour), label=name)
                for name, colour in colours.items()
            ],
            loc="upper right",
            bbox_to_anchor=(1 - RIGHT / self.width, 1 - 8 / self.height),
            ncols=len(colours),
            frameon=False,
            borderaxespad=0,
            borderpad=0.2,
            handletextpad=0.1,
            columnspacing=1.4,
        )

    def _draw_ensemble(self) -> None:
        """Charts of as many derived quantities as fit beside each other, with bands of the members."""
        curves = quantity_curves(self.trajectories)[: max(1, self.width // CHART_WIDTH)]
        for axes, each in zip(self._add_charts([each.name for each in curves]), curves, strict=True):
            draw_curves(axes, each, self.trajectories)

    def _draw_legends(self) -> None:
        """What bands and lines stand for: at the bottom, side by side where they fit, else one above the other."""
        side_by_side = self.width > 2 * LEGEND_WIDTH
        up, right = (12, LEFT + LEGEND_WIDTH) if side_by_side else (40, LEFT)
        add_legend(self.figure, legend_of_bands(self.trajectories), (LEFT / self.width, up / self.height))
        if self.trajectories.frame_count > 1:
            corner = right / self.width, 12 / self.height
            add_legend(self.figure, legend_of_curves(self.trajectories), corner)

    def _draw_errors(self) -> None:
        reference, *_ = self.trajectories.positions
        errors = self.trajectories.rms_errors()
        largest = max(1e-12, *(float(error.max()) for error in errors.values()))
        # A prediction with a larger error has left the box; showing all of it would flatten the rest of the curve.
        diagonal = math.dist(*zip(*self.trajectories.outer_bounds, strict=True))
        title = "RMS position error (length" + ("; cut at the box's diagonal)" if largest > diagonal else ")")
        (axes,) = self._add_charts([title])
        for (label, error), line in zip(errors.items(), LINE_COLOURS * len(errors), strict=False):
            axes.plot(error, color=line, lw=1.3, label=f"{label} against {reference}")
        axes.set_ylim(0, min(1.08 * largest, diagonal))
        if len(errors) > 1:
            axes.legend(frameon=False, loc="upper left", fontsize=FONT_SIZE - 1)

    def _add_charts(self, titles: list[str]) -> list[Any]:
        """Axes beside each other below the panels, with these titles, against the frames."""
        top, pitch = self.panels_bottom + ABOVE_CHART, (self.width - RIGHT) / len(titles)
        bottom, size = self.height - top - CHART, ((pitch - LEFT) / self.width, CHART / self.height)
        charts: list[Any] = []
        for index, title in enumerate(titles):
            left = LEFT + index * pitch
            box = np.array([left / self.width, bottom / self.height, *size])
            axes = add_frame_axes(self.figure, box, self.trajectories.frame_count)
            for frame in self.frames:
                axes.axvline(frame, color=hex_code(FAINT_TEXT), lw=0.5, alpha=0.45, zorder=0)
            axes.set_xlabel("frame", labelpad=2)
            self._write(left, top - 12, title, weight="bold")
            charts.append(axes)
        return charts

    def _write(
        self, right: float, down: float, text: str, colour: Rgb = TEXT, va: str = "bottom", **style: Any
    ) -> None:
        self.figure.text(
            right / self.width, 1 - down / self.height, text, color=hex_code(colour), va=va, **{"ha": "left"} | style
        )
