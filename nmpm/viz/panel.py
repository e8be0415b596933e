"""Panels: the box with its particles as small antialiased discs, drawn with NumPy and without matplotlib.

Everything is drawn on a canvas some times finer than the panel and averaged down, so that edges are smooth and motion
smaller than a pixel shows.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from nmpm.viz.camera import Camera, box_corners, camera_for, upright_axis
from nmpm.viz.colours import EDGE, INTERIOR, OBSTACLE, PAGE, WALL, Rgb, palette, shaded
from nmpm.viz.exhibit import Exhibit, Floats
from nmpm.viz.spacing import particle_spacing

FINENESS = 3
DISC = 1.2
"""Diameter of a disc in particle spacings: a little overlap, so that a body reads as one."""
DISC_LIMITS = (2.2, 24.0)
"""Smallest and largest diameter of a disc in pixels."""
HAZE = 0.55
"""How far the farthest particles of a 3-D scene fade into the background."""
CHUNK = 1_000_000
"""Canvas points written at once."""


class Panel:
    """Draws the frames of one exhibit at one size; every row is drawn by the same panel.

    Args:
        exhibit: What to draw.
        width: Width of the panel in pixels; its height follows from the box.
    """

    def __init__(self, exhibit: Exhibit, width: int) -> None:
        self.exhibit = exhibit
        self.camera: Camera = camera_for(exhibit)
        self.width = width
        self.height = max(1, round(width * self.camera.height / self.camera.width))
        self._scale = FINENESS * width / self.camera.width
        self._stamp = _disc(FINENESS * self._diameter / 2)
        # Obstacles come first, so that in 2-D the material lies on top of them.
        obstacles = np.tile(np.array(OBSTACLE, dtype=np.uint8), (len(exhibit.obstacles), 1))
        self._colours = np.concatenate([obstacles, shaded(self._material_colours())])

    def draw(self, position: Floats) -> NDArray[np.uint8]:
        """One frame.

        Args:
            position: (N, D) in domain length; particles outside the window are left out (`outside` counts them).

        Returns:
            (height, width, 3), top row first.
        """
        seen = self.camera.project(np.concatenate([self.exhibit.obstacles, self.exhibit.wrapped(position)]))
        inside = self._inside(seen)
        seen, colours = seen[inside], self._colours[inside]
        if self.camera.deep:
            order = np.argsort(seen[:, 2], kind="stable")
            seen, colours = seen[order], _hazy(colours[order], seen[order, 2])
        canvas = self._backdrop.copy()
        self._splat(canvas, seen, colours)
        # RGBX and not RGBA, whose reduction would first multiply by an opacity that is one everywhere.
        image = Image.frombuffer("RGBX", canvas.shape[::-1], canvas.tobytes(), "raw", "RGBX", 0, 1)
        return np.asarray(image.reduce(FINENESS))[..., :3]

    def outside(self, position: Floats) -> int:
        """How many of the particles (N, D) lie outside the window."""
        return int((~self._inside(self.camera.project(self.exhibit.wrapped(position)))).sum())

    def pixel(self, point: Floats) -> tuple[int, int]:
        """Row and column of the pixel at which a point (D,) is drawn."""
        right, up, _ = self.camera.project(point) * self._scale / FINENESS
        return int(self.height - up), int(right)

    @property
    def _diameter(self) -> float:
        spacing = particle_spacing(next(iter(self.exhibit.rows.values()))[0])
        return float(np.clip(DISC * spacing * self._scale / FINENESS, *DISC_LIMITS))

    def _material_colours(self) -> NDArray[np.uint8]:
        chosen = palette(self.exhibit.materials)
        names, inverse = np.unique(self.exhibit.material, return_inverse=True)
        return np.array([chosen[name] for name in names.tolist()], dtype=np.uint8)[inverse]

    def _inside(self, seen: NDArray[np.float64]) -> NDArray[np.bool_]:
        across, up = seen[:, 0], seen[:, 1]
        return (across >= 0) & (across < self.camera.width) & (up >= 0) & (up < self.camera.height)

    def _splat(self, canvas: NDArray[np.uint32], seen: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
        """Writes discs in order, so that later particles cover earlier ones; at the rim they are kept whole."""
        packed = np.full((len(colours), 4), 255, dtype=np.uint8)
        packed[:, :3] = colours
        ink = packed.view(np.uint32)
        rows, columns = canvas.shape
        reach = int(self._stamp.max())
        row = np.clip(np.int64(rows - seen[:, 1] * self._scale), reach, rows - 1 - reach)
        column = np.clip(np.int64(seen[:, 0] * self._scale), reach, columns - 1 - reach)
        centre = row * columns + column
        stamp = self._stamp[:, 0] * columns + self._stamp[:, 1]
        flat = canvas.reshape(-1)
        step = max(1, CHUNK // len(stamp))
        for start in range(0, len(centre), step):
            part = slice(start, start + step)
            flat[centre[part, None] + stamp] = ink[part]

    @cached_property
    def _backdrop(self) -> NDArray[np.uint32]:
        image = Image.new("RGBA", (self.width * FINENESS, self.height * FINENESS), (*PAGE, 255))
        draw = ImageDraw.Draw(image)
        if self.exhibit.dim == 2:
            self._paint_walls(draw)
        else:
            self._paint_box(draw)
        return np.array(image).view(np.uint32)[..., 0]

    def _paint_walls(self, draw: ImageDraw.ImageDraw) -> None:
        self._paint_rectangle(draw, self.exhibit.walls, WALL)
        self._paint_rectangle(draw, self.exhibit.bounds, INTERIOR)

    def _paint_rectangle(self, draw: ImageDraw.ImageDraw, box: tuple[tuple[float, float], ...], fill: Rgb) -> None:
        (left, bottom), (right, top) = self._canvas_points(np.array(box).T)
        draw.rectangle((left, top, right, bottom), fill=(*fill, 255), outline=(*EDGE, 255), width=FINENESS)

    def _paint_box(self, draw: ImageDraw.ImageDraw) -> None:
        corners = box_corners(self.exhibit.bounds)
        points = self._canvas_points(corners)
        up = upright_axis(self.exhibit)
        floor = np.flatnonzero(corners[:, up] == self.exhibit.bounds[up][0])[[0, 1, 3, 2]]
        draw.polygon([points[corner] for corner in floor], fill=(*INTERIOR, 255))
        for one in range(8):
            for other in (one ^ 1, one ^ 2, one ^ 4):
                draw.line((points[one], points[other]), fill=(*EDGE, 255), width=FINENESS)

    def _canvas_points(self, points: NDArray[Any]) -> list[tuple[float, float]]:
        seen = self.camera.project(points) * self._scale
        return [(float(right), float(self.height * FINENESS - up)) for right, up in seen[:, :2]]


def _disc(radius: float) -> NDArray[np.int64]:
    """Offsets (K, 2) of the canvas points within a disc."""
    reach = math.ceil(radius)
    offset = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    return np.asarray(offset[np.square(offset).sum(axis=1) <= radius * radius], dtype=np.int64)


def _hazy(colours: NDArray[np.uint8], nearness: NDArray[np.float64]) -> NDArray[np.uint8]:
    fade = HAZE * (1 - nearness[:, None])
    return np.asarray(colours * (1 - fade) + np.array(INTERIOR) * fade, dtype=np.uint8)
