"""Frames of an animation: one panel per trajectory, with labels, errors, the time and a legend of the materials."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nmpm.viz.camera import fit_camera
from nmpm.viz.captions import format_distance, format_out_of_view, format_time
from nmpm.viz.colours import BACKGROUND, FAINT_TEXT, OBSTACLE, TEXT, Rgb, material_colours
from nmpm.viz.panel_renderer import PanelRenderer
from nmpm.viz.trajectories import LabelledTrajectories

# Lengths in pixels.
MARGIN = 10
PANEL_HEADER = 26
FOOTER = 26
LINE_HEIGHT = 22
FONT_SIZE = 13
LEGEND_DOT = 9


class FrameRenderer:
    """Draws whole animation frames.

    Panels are side by side in the order of the trajectories; if the box is much wider than high, they are stacked.

    Args:
        trajectories: What to draw.
        side: Side of a square panel in pixels; stacked panels are wider.
    """

    def __init__(self, trajectories: LabelledTrajectories, side: int) -> None:
        self.trajectories = trajectories
        camera = fit_camera(trajectories)
        self._stacked = camera.width > 1.6 * camera.height
        stretch = min(3.0, math.sqrt(camera.width / camera.height)) if self._stacked else 1.0
        self._panel = PanelRenderer(trajectories, round(side * stretch))
        count = len(trajectories.positions)
        self._columns, self._rows = (1, count) if self._stacked else (count, 1)
        self._errors = trajectories.rms_errors()

    @property
    def width(self) -> int:
        """Width in pixels; even, because video codecs require it."""
        return _round_up_to_even(MARGIN + self._columns * (self._panel.width + MARGIN))

    @property
    def height(self) -> int:
        """Height in pixels; even, because video codecs require it."""
        return _round_up_to_even(
            self._title_height + self._rows * (PANEL_HEADER + self._panel.height) + FOOTER + self._legend_height
        )

    @property
    def colours(self) -> list[Rgb]:
        """Colours of the materials and the obstacles."""
        return [*material_colours(self.trajectories.materials).values(), OBSTACLE]

    def draw(self, frame: int) -> NDArray[np.uint8]:
        """Draws one frame of the trajectories, (height, width, 3)."""
        image = self._template.copy()
        draw = ImageDraw.Draw(image)
        for index, (label, position) in enumerate(self.trajectories.positions.items()):
            left, top = self._corner(index)
            image.paste(Image.fromarray(self._panel.draw(position[frame])), (left, top))
            notes = [format_out_of_view(self._panel.count_outside(position[frame]))]
            if label in self._errors:
                notes.append(f"RMS error {format_distance(self.trajectories, self._errors[label][frame])}")
            text = ", ".join(filter(None, notes))
            draw.text((left + self._panel.width, top - 6), text, FAINT_TEXT, self._font, anchor="rs")
        draw.text((MARGIN, self._footer_baseline), self._time_text(frame), TEXT, self._font, anchor="ls")
        return np.asarray(image)

    @cached_property
    def _template(self) -> Image.Image:
        """The parts that are the same in every frame: title, labels and legend."""
        image = Image.new("RGB", (self.width, self.height), BACKGROUND)
        draw = ImageDraw.Draw(image)
        draw.text((MARGIN, 18), self.trajectories.title, TEXT, self._bold_font, anchor="ls")
        for index, label in enumerate(self.trajectories.positions):
            left, top = self._corner(index)
            draw.text((left, top - 6), label, TEXT, self._bold_font, anchor="ls")
        self._draw_legend(draw)
        return image

    def _draw_legend(self, draw: ImageDraw.ImageDraw) -> None:
        right, baseline = self.width - MARGIN, self._footer_baseline + self._legend_height
        for name, colour in reversed(self._legend.items()):
            draw.text((right, baseline), name, TEXT, self._font, anchor="rs")
            right -= self._text_width(name) + LEGEND_DOT + 5
            draw.ellipse((right, baseline - LEGEND_DOT, right + LEGEND_DOT, baseline), fill=colour)
            right -= 14

    def _corner(self, index: int) -> tuple[int, int]:
        """Left and upper edge of a panel."""
        row, column = (index, 0) if self._stacked else (0, index)
        top = self._title_height + row * (PANEL_HEADER + self._panel.height) + PANEL_HEADER
        return MARGIN + column * (self._panel.width + MARGIN), top

    def _time_text(self, frame: int) -> str:
        return f"frame {frame} of {self.trajectories.frame_count - 1}   {format_time(self.trajectories, frame)}"

    def _text_width(self, text: str) -> int:
        return int(np.ceil(self._font.getlength(text)))

    @property
    def _footer_baseline(self) -> int:
        """Vertical position of the first footer line's baseline."""
        return self._title_height + self._rows * (PANEL_HEADER + self._panel.height) + 18

    @property
    def _title_height(self) -> int:
        return LINE_HEIGHT if self.trajectories.title else 0

    @cached_property
    def _legend(self) -> dict[str, Rgb]:
        return material_colours(self.trajectories.materials) if len(self.trajectories.materials) > 1 else {}

    @cached_property
    def _legend_height(self) -> int:
        """Height of the second footer line, used if the legend does not fit beside the time; otherwise 0."""
        taken = self._text_width(self._time_text(self.trajectories.frame_count - 1)) + 2 * MARGIN + 20
        legend = sum(self._text_width(name) + LEGEND_DOT + 19 for name in self._legend)
        return LINE_HEIGHT if self._legend and taken + legend > self.width else 0

    @cached_property
    def _font(self) -> ImageFont.FreeTypeFont:
        return _load_font("DejaVuSans.ttf")

    @cached_property
    def _bold_font(self) -> ImageFont.FreeTypeFont:
        return _load_font("DejaVuSans-Bold.ttf")


def _load_font(name: str) -> ImageFont.FreeTypeFont:
    # The font of the snapshots, which matplotlib ships.
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, FONT_SIZE)


def _round_up_to_even(length: int) -> int:
    return length + length % 2
