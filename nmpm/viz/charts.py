"""Charts of an ensemble against the frames: its bands, the member that is shown, and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from nmpm.colours import TEXT, hex_code
from nmpm.viz.ensembles import BANDS, LEVELS, QuantityCurves, band_colours, ensemble_colour, quantity_curves
from nmpm.viz.trajectories import LabelledTrajectories

TRUTH_LINE: dict[str, Any] = {"color": hex_code(TEXT), "lw": 1.2, "ls": (0, (4, 1.5))}

# Of the charts below an animation, in pixels.
DPI, FONT_SIZE = 100, 8.0
HEIGHT, SMALLEST_WIDTH = 150, 200
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 24, 68


def draw_curves(axes: Any, curves: QuantityCurves, trajectories: LabelledTrajectories) -> None:
    """Draws the bands, wide and light before narrow and dark, the member that is shown, and the truth."""
    frames = range(trajectories.frame_count)
    colours = [hex_code(colour) for colour in band_colours(trajectories.materials)]
    for (low, high), colour in zip(curves.bands().values(), colours, strict=False):
        axes.fill_between(frames, low, high, color=colour, lw=0)
    axes.plot(curves.members[0], color=hex_code(ensemble_colour(trajectories.materials)), lw=1.2)
    if curves.truth is not None:
        axes.plot(curves.truth, **TRUTH_LINE)


def legend_of_bands(trajectories: LabelledTrajectories) -> list[Patch | Line2D]:
    """What the tints behind the particles stand for."""
    colours = [hex_code(colour) for colour in band_colours(trajectories.materials)]
    text = f"where {_percentages(LEVELS)} of {len(trajectories.members)} members are"
    return [Patch(color=colour, lw=0, label=label) for colour, label in zip(colours, ("", "", text), strict=True)]


def legend_of_curves(trajectories: LabelledTrajectories) -> list[Patch | Line2D]:
    """What bands and lines of the charts stand for."""
    colours = [hex_code(colour) for colour in band_colours(trajectories.materials)]
    labels = ("", f"{_percentages(tuple(reversed(BANDS)))} of members")
    bands = [Patch(color=colour, lw=0, label=label) for colour, label in zip(colours, labels, strict=False)]
    shown = Line2D([], [], color=hex_code(ensemble_colour(trajectories.materials)), lw=1.2)
    shown.set_label(next(iter(trajectories.members)))
    lines = [shown]
    if trajectories.truth is not None:
        lines.append(Line2D([], [], label=next(iter(trajectories.positions)), **TRUTH_LINE))
    return [*bands, *lines]


def _percentages(shares: Sequence[float]) -> str:
    return ", ".join(f"{100 * share:.0f}" for share in shares) + "%"


class ChartStrip:
    """Charts beside each other below an animation, with their legends.

    Args:
        trajectories: An ensemble of several frames.
        width: In pixels; as many charts are drawn as fit.
    """

    def __init__(self, trajectories: LabelledTrajectories, width: int) -> None:
        curves = quantity_curves(trajectories)[: max(1, width // SMALLEST_WIDTH)]
        self._frames = trajectories.frame_count
        self._pitch = width / len(curves)
        self._count = len(curves)
        with mpl.rc_context({"font.family": "DejaVu Sans", "font.size": FONT_SIZE, "axes.linewidth": 0.6}):
            figure = Figure(figsize=(width / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
            canvas = FigureCanvasAgg(figure)
            for index, each in enumerate(curves):
                box = (index * self._pitch + LEFT, BOTTOM, self._pitch - LEFT - RIGHT, HEIGHT - TOP - BOTTOM)
                axes = add_frame_axes(figure, np.divide(box, (width, HEIGHT, width, HEIGHT)), self._frames, ticks=3)
                axes.set_title(each.name, loc="left", fontsize=FONT_SIZE - 0.5, pad=5)
                draw_curves(axes, each, trajectories)
            for handles, up in ((legend_of_bands(trajectories), 26), (legend_of_curves(trajectories), 8)):
                add_legend(figure, handles, (LEFT / width, up / HEIGHT))
            canvas.draw()
            self.image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

    def draw(self, frame: int) -> Image.Image:
        """The charts with a line at a frame."""
        image = self.image.copy()
        draw = ImageDraw.Draw(image)
        for index in range(self._count):
            left, right = index * self._pitch + LEFT, (index + 1) * self._pitch - RIGHT
            x = round(left + (right - left) * frame / (self._frames - 1))
            draw.line((x, TOP, x, HEIGHT - BOTTOM), TEXT)
        return image


def add_frame_axes(figure: Figure, box: NDArray[np.float64], frames: int, ticks: int = 4) -> Any:
    """Adds axes whose first one counts frames, in a box (left, bottom, width, height) as shares of the figure."""
    axes: Any = figure.add_axes(tuple(box.tolist()))
    axes.set_xlim(0, frames - 1)
    axes.yaxis.set_major_locator(MaxNLocator(ticks))
    axes.yaxis.set_major_formatter("{x:g}")
    size = float(mpl.rcParams["font.size"])
    axes.tick_params(length=2.5, width=0.6, labelsize=size - 1, colors=hex_code(TEXT))
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def add_legend(figure: Figure, handles: list[Patch | Line2D], corner: tuple[float, float]) -> None:
    """Adds a legend in one row, with its lower left corner at these shares of the figure's size."""
    figure.legend(
        handles=handles,
        ncols=len(handles),
        bbox_to_anchor=corner,
        loc="lower left",
        frameon=False,
        borderaxespad=0,
        borderpad=0,
        handlelength=1.4,
        handletextpad=0.4,
        columnspacing=0.6,
        fontsize=float(mpl.rcParams["font.size"]) - 0.5,
    )
