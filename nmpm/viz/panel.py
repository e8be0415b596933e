"""Panels: the box with its particles as small antialiased discs, drawn with NumPy and Pillow, and texts beside them.

Everything is drawn on a canvas finer than the panel and averaged, so that edges are smooth and motion smaller than a
pixel is visible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from nmpm.colours import BACKGROUND, EDGE, INTERIOR, OBSTACLE, TEXT, WALL, material_colours
from nmpm.viz.camera import Camera, box_corners, fit_camera, vertical_axis
from nmpm.viz.ensembles import CELL, LEVELS, band_colours, occupied_share
from nmpm.viz.trajectories import Floats, LabelledTrajectories

SUPERSAMPLING = 3
"""Canvas points per pixel along each axis."""
DISC_DIAMETER = 2.2
"""Diameter of a disc in particle spacings: discs of neighbours overlap, also where a model spreads them unevenly."""
DIAMETER_LIMITS = (2.2, 24.0)
"""Smallest and largest diameter of a disc in pixels."""
DEPTH_FADE = 0.55
"""Fraction of the background in the colour of the farthest particles of a 3-D scene."""
ARROW_SHARE = 0.055
"""Radius of the disc that shows gravity, as a share of the panel's shorter side."""
ARROW_LIMITS = (9.0, 24.0)
"""Smallest and largest radius of it in pixels."""
CHUNK_POINTS = 1_000_000
"""Largest number of canvas points written at once."""
SAMPLES = 64
"""Particles from which the spacing is estimated."""
NEIGHBOURS = {2: 6, 3: 12}
"""Neighbours per dimension: enough to average over random placement, few enough to be local."""
UNIT_BALL_VOLUME = {2: math.pi, 3: 4 * math.pi / 3}


class PanelRenderer:
    """Draws single frames of single trajectories, all at one size.

    Args:
        trajectories: What to draw.
        width: Width of the panel in pixels; the height follows from the shape of the box.
    """

    def __init__(self, trajectories: LabelledTrajectories, width: int) -> None:
        self.trajectories = trajectories
        self.camera: Camera = fit_camera(trajectories)
        self.width = width
        self.height = max(1, round(width * self.camera.height / self.camera.width))
        self._scale = SUPERSAMPLING * width / self.camera.width
        self._spacing = particle_spacing(trajectories.fullest_frame)
        diameter = float(np.clip(DISC_DIAMETER * self._spacing * width / self.camera.width, *DIAMETER_LIMITS))
        diameter = min(diameter, 0.9 * min(width, self.height))  # a whole disc fits into the panel of an oblong box
        self._disc = _disc_offsets(SUPERSAMPLING * diameter / 2)
        colours = material_colours(trajectories.materials)
        materials = np.array([colours[name] for name in trajectories.material.tolist()], dtype=np.uint8)
        # Obstacles come first, so that material is drawn over them in 2-D.
        obstacles = np.tile(np.array(OBSTACLE, dtype=np.uint8), (len(trajectories.obstacles), 1))
        self._colours = np.concatenate([obstacles, materials])

    def draw(self, position: Floats, ensemble: Sequence[Floats] = ()) -> NDArray[np.uint8]:
        """Draws one frame.

        Args:
            position: (N, D) in domain length; particles that are not there, NaN, or outside of the window are omitted
                (see `count_outside`).
            ensemble: (N, D) of each member; behind the particles, the picture is darker where more of them are.

        Returns:
            (height, width, 3), top row first.
        """
        projected = self.camera.project(np.concatenate([self.trajectories.obstacles, self.trajectories.wrap(position)]))
        inside = self._inside(projected)
        projected, colours = projected[inside], self._colours[inside]
        if self.camera.has_depth:
            order = np.argsort(projected[:, 2], kind="stable")
            projected, colours = projected[order], _fade_by_depth(colours[order], projected[order, 2])
        canvas = self._background.copy()
        if ensemble:
            self._draw_bands(canvas, ensemble)
        self._draw_discs(canvas, projected, colours)
        # RGBX because reducing RGBA would first multiply by the opacity, which is 1 everywhere.
        image = Image.frombuffer("RGBX", canvas.shape[::-1], canvas.tobytes(), "raw", "RGBX", 0, 1)
        if self.trajectories.tilt is not None:
            self._draw_gravity(ImageDraw.Draw(image), self.trajectories.tilt)
        return np.asarray(image.reduce(SUPERSAMPLING))[..., :3]

    def count_outside(self, position: Floats) -> int:
        """Counts the particles (N, D) outside of the window."""
        there = position[~np.isnan(position[:, 0])]
        return int((~self._inside(self.camera.project(self.trajectories.wrap(there)))).sum())

    def _inside(self, projected: NDArray[np.float64]) -> NDArray[np.bool_]:
        right, up = projected[:, 0], projected[:, 1]
        return (right >= 0) & (right < self.camera.width) & (up >= 0) & (up < self.camera.height)

    def _draw_discs(
        self, canvas: NDArray[np.uint32], projected: NDArray[np.float64], colours: NDArray[np.uint8]
    ) -> None:
        """Draws discs in order, later ones over earlier ones; at the edges they are shifted inwards to stay whole."""
        packed = np.full((len(colours), 4), 255, dtype=np.uint8)
        packed[:, :3] = colours
        values = packed.view(np.uint32)
        rows, columns = canvas.shape
        reach = int(self._disc.max())
        row = np.clip(np.int64(rows - projected[:, 1] * self._scale), reach, rows - 1 - reach)
        column = np.clip(np.int64(projected[:, 0] * self._scale), reach, columns - 1 - reach)
        centre = row * columns + column
        offsets = self._disc[:, 0] * columns + self._disc[:, 1]
        flat = canvas.reshape(-1)
        step = max(1, CHUNK_POINTS // len(offsets))
        for start in range(0, len(centre), step):
            part = slice(start, start + step)
            flat[centre[part, None] + offsets] = values[part]

    def _draw_bands(self, canvas: NDArray[np.uint32], ensemble: Sequence[Floats]) -> None:
        """Tints the places that at least some shares of the members occupy, as seen by the camera."""
        width, height = self.camera.width, self.camera.height
        cell = max(min(CELL * self._spacing, width / 20), width / self.width)
        columns, rows = math.ceil(width / cell), math.ceil(height / cell)
        seen = (self.camera.project(self.trajectories.wrap(position))[:, :2] for position in ensemble)
        share = occupied_share(seen, np.zeros(2), cell, (columns, rows)).T[::-1].astype(np.float32)
        box = (0.0, rows - height / cell, width / cell, float(rows))
        smooth = np.asarray(Image.fromarray(share).resize(canvas.shape[::-1], Image.Resampling.BICUBIC, box))
        colours = np.array([INTERIOR, BACKGROUND, *band_colours(self.trajectories.materials)], dtype=np.uint8)
        interior, background, *tints = (
            np.pad(colours, ((0, 0), (0, 1)), constant_values=255).view(np.uint32)[:, 0].tolist()
        )
        free = canvas == interior
        if self.camera.has_depth:
            free |= canvas == background
        for level, tint in zip(LEVELS, tints, strict=True):
            canvas[free & (smooth >= level)] = tint

    def _draw_gravity(self, draw: ImageDraw.ImageDraw, tilt: float) -> None:
        """An arrow that points where gravity does, on a disc in the upper right corner."""
        (_, _), (right, top) = self._canvas_points(np.array(self.trajectories.bounds).T)
        radius = SUPERSAMPLING * min(max(ARROW_SHARE * min(self.width, self.height), ARROW_LIMITS[0]), ARROW_LIMITS[1])
        x, y = right - 1.4 * radius, top + 1.4 * radius
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), (*BACKGROUND, 255), (*EDGE, 255), SUPERSAMPLING)
        along = radius * np.array([math.sin(tilt), math.cos(tilt)])  # on the canvas, whose second axis points down
        across = np.array([along[1], -along[0]])
        tail, neck, tip = (np.array([x, y]) + share * along for share in (-0.7, 0.1, 0.75))
        width = max(SUPERSAMPLING, round(0.22 * radius))
        draw.line([tuple(tail), tuple(neck)], (*TEXT, 255), width)
        draw.polygon([tuple(point) for point in (tip, neck + 0.4 * across, neck - 0.4 * across)], (*TEXT, 255))

    @cached_property
    def _background(self) -> NDArray[np.uint32]:
        image = Image.new("RGBA", (self.width * SUPERSAMPLING, self.height * SUPERSAMPLING), (*BACKGROUND, 255))
        draw = ImageDraw.Draw(image)
        bounds = self.trajectories.bounds
        if self.trajectories.dim == 2:
            for box, fill in ((self.trajectories.outer_bounds, WALL), (bounds, INTERIOR)):
                (left, bottom), (right, top) = self._canvas_points(np.array(box).T)
                draw.rectangle((left, top, right, bottom), (*fill, 255), (*EDGE, 255), SUPERSAMPLING)
        else:
            corners, vertical = box_corners(bounds), vertical_axis(self.trajectories)
            points = self._canvas_points(corners)
            floor = np.flatnonzero(corners[:, vertical] == bounds[vertical][0])[[0, 1, 3, 2]]
            draw.polygon([points[corner] for corner in floor], fill=(*INTERIOR, 255))
            for one in range(8):
                for other in (one ^ 1, one ^ 2, one ^ 4):
                    draw.line((points[one], points[other]), (*EDGE, 255), SUPERSAMPLING)
        return np.array(image).view(np.uint32)[..., 0]

    def _canvas_points(self, points: NDArray[Any]) -> list[tuple[float, float]]:
        projected = self.camera.project(points) * self._scale
        return [(float(right), float(self.height * SUPERSAMPLING - up)) for right, up in projected[:, :2]]


def _disc_offsets(radius: float) -> NDArray[np.int64]:
    """Offsets (K, 2) of the canvas points within a disc of this radius."""
    reach = math.ceil(radius)
    offset = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    return np.asarray(offset[np.square(offset).sum(axis=1) <= radius * radius], dtype=np.int64)


def _fade_by_depth(colours: NDArray[np.uint8], nearness: NDArray[np.float64]) -> NDArray[np.uint8]:
    fade = DEPTH_FADE * (1 - nearness[:, None])
    return np.asarray(colours * (1 - fade) + np.array(INTERIOR) * fade, dtype=np.uint8)


def particle_spacing(position: Floats) -> float:
    """Edge of the square or cube that one particle occupies, in domain length.

    A ball around a particle with the distance to its k-th neighbour as radius contains about k + 1/2 particles; the
    median radius over a sample of particles gives the spacing. The result is within 2% of the spacing of a regular
    lattice. For random positions it is the mean spacing, about twice the mean distance to the nearest neighbour.

    Args:
        position: (N, D), one frame; D is 2 or 3.

    Returns:
        The spacing; infinite for a single particle, or none.
    """
    count, dim = position.shape
    neighbours = min(NEIGHBOURS[dim], count - 1)
    if neighbours <= 0:
        return math.inf
    sample = position[np.linspace(0, count - 1, min(SAMPLES, count)).astype(int)].astype(np.float64)
    # One axis at a time, because the differences of all axes together exceed the cache.
    squares = np.zeros((len(sample), count))
    for axis in range(dim):
        squares += np.square(sample[:, axis, None] - position[None, :, axis])
    radius = np.sqrt(np.partition(squares, neighbours, axis=1)[:, neighbours])
    return float((UNIT_BALL_VOLUME[dim] * np.median(radius) ** dim / (neighbours + 0.5)) ** (1 / dim))


def format_time(trajectories: LabelledTrajectories, frame: int) -> str:
    """The time of a frame in seconds, with the same number of decimals for every frame."""
    longest = max(trajectories.frame_count - 1, 1) * trajectories.dt
    decimals = max(0, 2 - math.floor(math.log10(longest)))
    return f"{frame * trajectories.dt:.{decimals}f} s"
