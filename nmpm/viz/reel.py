"""The frames of an animation: one panel per trajectory, their labels, the time and the materials."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from nmpm.viz.camera import camera_for
from nmpm.viz.captions import clock, distance, unseen
from nmpm.viz.colours import FAINT_INK, INK, OBSTACLE, PAGE, Rgb, palette
from nmpm.viz.exhibit import Exhibit
from nmpm.viz.panel import Panel

RIM = 10
HEADER = 26
FOOTER = 26
LINE = 22
FONT = 13
DOT = 9


class Reel:
    """Draws whole animation frames.

    Panels stand side by side in the exhibit's order; those of a box much wider than high stand one above the other.

    Args:
        exhibit: What to draw.
        side: Side of a square panel in pixels; a wide panel is wider.
    """

    def __init__(self, exhibit: Exhibit, side: int) -> None:
        self.exhibit = exhibit
        camera = camera_for(exhibit)
        self._stacked = camera.width > 1.6 * camera.height
        stretch = min(3.0, math.sqrt(camera.width / camera.height)) if self._stacked else 1.0
        self._panel = Panel(exhibit, round(side * stretch))
        self._across, self._down = (1, len(exhibit.rows)) if self._stacked else (len(exhibit.rows), 1)
        self._errors = exhibit.errors()

    @property
    def width(self) -> int:
        """Width in pixels, even as video codecs require."""
        return _even(RIM + self._across * (self._panel.width + RIM))

    @property
    def height(self) -> int:
        """Height in pixels, even as video codecs require."""
        return _even(self._titled + self._down * (HEADER + self._panel.height) + FOOTER + self._legend_line)

    @property
    def colours(self) -> list[Rgb]:
        """The materials' and obstacles' colours."""
        return [*palette(self.exhibit.materials).values(), OBSTACLE]

    def draw(self, frame: int) -> NDArray[np.uint8]:
        """One frame of the trajectories, (height, width, 3)."""
        image = self._unchanging.copy()
        draw = ImageDraw.Draw(image)
        for index, (label, position) in enumerate(self.exhibit.rows.items()):
            left, top = self._corner(index)
            image.paste(Image.fromarray(self._panel.draw(position[frame])), (left, top))
            words = [unseen(self._panel.outside(position[frame]))]
            if label in self._errors:
                words.append(f"RMS error {distance(self.exhibit, self._errors[label][frame])}")
            note = ", ".join(word for word in words if word)
            draw.text((left + self._panel.width, top - 6), note, FAINT_INK, self._font, anchor="rs")
        draw.text((RIM, self._footer), self._time(frame), INK, self._font, anchor="ls")
        return np.asarray(image)

    @cached_property
    def _unchanging(self) -> Image.Image:
        """What is the same in every frame."""
        image = Image.new("RGB", (self.width, self.height), PAGE)
        draw = ImageDraw.Draw(image)
        draw.text((RIM, 18), self.exhibit.title, INK, self._bold, anchor="ls")
        for index, label in enumerate(self.exhibit.rows):
            left, top = self._corner(index)
            draw.text((left, top - 6), label, INK, self._bold, anchor="ls")
        self._draw_legend(draw)
        return image

    def _draw_legend(self, draw: ImageDraw.ImageDraw) -> None:
        right, base = self.width - RIM, self._footer + self._legend_line
        for name, ink in reversed(self._legend.items()):
            draw.text((right, base), name, INK, self._font, anchor="rs")
            right -= self._length(name) + DOT + 5
            draw.ellipse((right, base - DOT, right + DOT, base), fill=ink)
            right -= 14

    def _corner(self, index: int) -> tuple[int, int]:
        row, column = (index, 0) if self._stacked else (0, index)
        top = self._titled + row * (HEADER + self._panel.height) + HEADER
        return RIM + column * (self._panel.width + RIM), top

    def _time(self, frame: int) -> str:
        return f"frame {frame} of {self.exhibit.frames - 1}   {clock(self.exhibit, frame)}"

    def _length(self, text: str) -> int:
        return int(np.ceil(self._font.getlength(text)))

    @property
    def _footer(self) -> int:
        """Base line of the first footer line."""
        return self._titled + self._down * (HEADER + self._panel.height) + 18

    @property
    def _titled(self) -> int:
        return LINE if self.exhibit.title else 0

    @cached_property
    def _legend(self) -> dict[str, Rgb]:
        return palette(self.exhibit.materials) if len(self.exhibit.materials) > 1 else {}

    @cached_property
    def _legend_line(self) -> int:
        """Height of a line of the legend's own, where it does not fit beside the time."""
        taken = self._length(self._time(self.exhibit.frames - 1)) + 2 * RIM + 20
        legend = sum(self._length(name) + DOT + 19 for name in self._legend)
        return LINE if self._legend and taken + legend > self.width else 0

    @cached_property
    def _font(self) -> ImageFont.FreeTypeFont:
        return _typeface("DejaVuSans.ttf")

    @cached_property
    def _bold(self) -> ImageFont.FreeTypeFont:
        return _typeface("DejaVuSans-Bold.ttf")


def _typeface(name: str) -> ImageFont.FreeTypeFont:
    # matplotlib carries the typeface that the snapshots are set in.
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, FONT)


def _even(length: int) -> int:
    return length + length % 2
