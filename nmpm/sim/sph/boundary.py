"""The box and the obstacles in it, as dummy particles that act on the fluid and as surfaces that it cannot cross.

Dummy particles continue the fluid's lattice into the solid, three layers deep, the kernel's reach (Adami, Hu & Adams,
"A generalized wall boundary condition for smoothed particle hydrodynamics", 2012): the first layer lies half a spacing
behind the surface. Obstacles carry closed rings of them, parallel to their edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.state import Array, Obstacle, check_numbers

LAYERS = 3
"""Layers of dummy particles below a surface: the kernel's reach."""

_RESTARTS = 50
_ATTEMPTS = 500

# Distance from a surface, in spacings, at which a particle is clamped. Float32 can still tell it from the surface.
_MARGIN = 1e-3


@dataclass(frozen=True)
class PolygonObstacle(Obstacle):
    """A convex polygon.

    Args:
        corners: (V, 2) in length, counter-clockwise.
    """

    corners: Array

    @property
    def normals(self) -> Array:
        """(V, 2) unit normals of the edges, outwards; edge k runs from corner k to the next."""
        edge = np.roll(self.corners, -1, axis=0) - self.corners
        return np.asarray(np.stack([edge[:, 1], -edge[:, 0]], -1) / np.linalg.norm(edge, axis=1, keepdims=True))

    @property
    def offsets(self) -> Array:
        """(V,) such that a point x is inside where normals @ x < offsets."""
        return np.asarray((self.normals * self.corners).sum(-1))

    def distance(self, points: NDArray[np.floating]) -> Array:
        """(K,) signed distance of points (K, 2) from the nearest edge's line: too small beyond corners."""
        return np.asarray((points @ self.normals.T - self.offsets).max(-1))

    def moved(self, shift: Array) -> Self:
        return replace(self, corners=self.corners + shift)


@dataclass(frozen=True)
class ObstacleRanges:
    """How obstacles are drawn: turned boxes and right-angled triangles, apart from each other and the box's sides.

    Args:
        number: Least and most of them.
        size: Least and largest width and height before turning, in length.
        gap: Least distance between their circumcircles, and from these to the box's sides, in length.
    """

    number: tuple[int, int]
    size: tuple[float, float]
    gap: float

    def __post_init__(self) -> None:
        check_numbers(self, "obstacles.", positive=("size",), at_least_0=("number", "gap"))

    def max_particles(self, spacing: float) -> int:
        """Upper bound of their dummy particles."""
        return self.number[1] * LAYERS * math.ceil(4 * self.size[1] / spacing)

    def draw(self, box: tuple[Interval, Interval], rng: np.random.Generator) -> tuple[PolygonObstacle, ...]:
        """Random obstacles within a box; ConfigError if no arrangement fits into it."""
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_RESTARTS):
            placed = self._place(number, box, rng)
            if placed is not None:
                return placed
        raise ConfigError(f"No room for {number} obstacles of obstacles.size = {list(self.size)} within {box}.")

    def _place(
        self, number: int, box: tuple[Interval, Interval], rng: np.random.Generator
    ) -> tuple[PolygonObstacle, ...] | None:
        """Obstacles placed one after the other, or None if the first ones leave no room for the others."""
        low, high = np.array(box).T
        placed: list[tuple[Array, float, PolygonObstacle]] = []
        for _ in range(_ATTEMPTS):
            if len(placed) == number:
                return tuple(obstacle for _, _, obstacle in placed)
            corners = _draw_corners(rng.uniform(*self.size, 2), rng)
            radius = float(np.linalg.norm(corners, axis=1).max())
            keep = radius + self.gap
            if np.any(high - low < 2 * keep):
                continue
            centre = rng.uniform(low + keep, high - keep)
            if all(np.linalg.norm(centre - other) >= keep + size for other, size, _ in placed):
                placed.append((centre, radius, PolygonObstacle(centre + corners)))
        return None


def _draw_corners(size: Array, rng: np.random.Generator) -> Array:
    """Corners of a box, or of the triangle that three of them make, about its centre and turned by any angle."""
    corners = 0.5 * size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    count, angle = rng.integers(3, 5), rng.uniform(0, 2 * math.pi)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(corners[:count] @ np.array([[cos, sin], [-sin, cos]]))


def box_particles(box: tuple[Interval, Interval], spacing: float) -> tuple[Array, NDArray[np.int64]]:
    """Positions (M, 2) of the dummy particles around a box, and the layer of each, 0 being next to the fluid."""
    axes, layers = [], []
    for low, high in box:
        count = round((high - low) / spacing)
        deep = np.arange(LAYERS)
        inner = low + spacing * (np.arange(count) + 0.5)
        axes.append(np.concatenate([low - spacing * (deep[::-1] + 0.5), inner, high + spacing * (deep + 0.5)]))
        layers.append(np.concatenate([deep[::-1], np.full(count, -1), deep]))
    position = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    layer = np.maximum(*np.meshgrid(*layers, indexing="ij")).reshape(-1)
    return position[layer >= 0], layer[layer >= 0]


def obstacle_particles(obstacle: PolygonObstacle, spacing: float) -> Array:
    """Dummy particles within an obstacle, (M, 2): rings at half a spacing, one and a half, … below its surface."""
    rings = [_ring(obstacle, spacing * (layer + 0.5), spacing) for layer in range(LAYERS)]
    return np.concatenate(rings)


def _ring(obstacle: PolygonObstacle, depth: float, spacing: float) -> Array:
    """Points along the polygon that lies `depth` below the surface; none where the obstacle is thinner."""
    normals, offsets = obstacle.normals, obstacle.offsets - depth
    # Each inner corner is where two neighbouring edges, moved inwards, meet.
    planes = np.stack([np.roll(normals, 1, axis=0), normals], axis=1)
    corners = np.linalg.solve(planes, np.stack([np.roll(offsets, 1), offsets], -1)[..., None])[..., 0]
    if np.any(-obstacle.distance(corners) < depth * (1 - 1e-9)):
        return np.empty((0, 2))
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    length = sides.sum()
    along = np.arange(max(1, round(length / spacing))) * length / max(1, round(length / spacing))
    closed = np.concatenate([corners, corners[:1]])
    reached = np.concatenate([[0.0], np.cumsum(sides)])
    return np.stack([np.interp(along, reached, closed[:, axis]) for axis in range(2)], -1)


class SolidBoundary:
    """The box and its obstacles, as dummy particles and as surfaces.

    Args:
        box: Where the fluid may be, (lower, upper) along x and y, in length.
        obstacles: Where it may not.
        spacing: Of the particles, in length.
    """

    def __init__(self, box: tuple[Interval, Interval], obstacles: tuple[PolygonObstacle, ...], spacing: float) -> None:
        low, high = np.array(box, np.float64).T
        self.margin = _MARGIN * spacing
        around, layer = box_particles(box, spacing)
        inner = _particles_of_all(obstacles, low, high, spacing)
        self.position: Array = np.concatenate([around, inner])
        """(M, 2) of all dummy particles."""
        self.visible: NDArray[np.bool_] = np.concatenate([layer == 0, np.ones(len(inner), np.bool_)])
        """(M,) whether a trajectory contains it: the box's first layer, and obstacles."""
        self._planes = np.concatenate(
            [np.column_stack([o.normals, o.offsets]) for o in obstacles] or [np.empty((0, 3))]
        )
        self._ends = np.cumsum([0] + [len(o.corners) for o in obstacles])
        self._box, self._obstacles = (low, high), obstacles
        self._low, self._high = low + self.margin, high - self.margin

    def clamp(self, x: Array, y: Array, vx: Array, vy: Array) -> int:
        """Move particles that have crossed a surface back to it, without velocity into the solid; returns how many."""
        held: int = _clamp(x, y, vx, vy, self._low, self._high, self._planes, self._ends, self.margin)
        return held

    def count_outside(self, points: NDArray[np.floating]) -> int:
        """How many points (N, 2) lie outside of the box or in an obstacle."""
        low, high = self._box
        wrong = ~np.all((points >= low) & (points <= high), axis=1)
        for obstacle in self._obstacles:
            wrong |= obstacle.distance(points) < 0
        return int(wrong.sum())


def _particles_of_all(obstacles: tuple[PolygonObstacle, ...], low: Array, high: Array, spacing: float) -> Array:
    """Dummy particles of all obstacles; those outside of the box or in an earlier obstacle are left out."""
    kept = [np.empty((0, 2))]
    for index, obstacle in enumerate(obstacles):
        points = obstacle_particles(obstacle, spacing)
        mine = np.all((points > low) & (points < high), axis=1)
        for earlier in obstacles[:index]:
            mine &= earlier.distance(points) > 0
        kept.append(points[mine])
    return np.concatenate(kept)


@jit
def _clamp(
    x: Array,
    y: Array,
    vx: Array,
    vy: Array,
    low: Array,
    high: Array,
    planes: Array,
    ends: NDArray[np.int64],
    margin: float,
) -> int:
    held = 0
    for i in range(x.shape[0]):
        before_x, before_y = x[i], y[i]
        for k in range(ends.shape[0] - 1):
            depth, nearest = math.inf, 0
            for edge in range(ends[k], ends[k + 1]):
                below = planes[edge, 2] + margin - planes[edge, 0] * x[i] - planes[edge, 1] * y[i]
                if below < depth:
                    depth, nearest = below, edge
                    if depth <= 0.0:
                        break
            if depth > 0.0:
                nx, ny = planes[nearest, 0], planes[nearest, 1]
                into = min(0.0, nx * vx[i] + ny * vy[i])
                x[i], y[i] = x[i] + depth * nx, y[i] + depth * ny
                vx[i], vy[i] = vx[i] - into * nx, vy[i] - into * ny
        # The box comes last: it holds even where an obstacle touches it.
        if x[i] < low[0]:
            x[i], vx[i] = low[0], max(0.0, vx[i])
        elif x[i] > high[0]:
            x[i], vx[i] = high[0], min(0.0, vx[i])
        if y[i] < low[1]:
            y[i], vy[i] = low[1], max(0.0, vy[i])
        elif y[i] > high[1]:
            y[i], vy[i] = high[1], min(0.0, vy[i])
        if x[i] != before_x or y[i] != before_y:
            held += 1
    return held
