"""Obstacles in the way of the fluid: convex polygons, and how they are drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.arrays import Array
from nmpm.sim.config import check
from nmpm.sim.initial_state import Obstacle

LAYERS = 3
"""Layers of dummy particles below a surface: the kernel's reach."""

_RESTARTS = 50
_ATTEMPTS = 500


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

    def depth(self, points: NDArray[np.floating]) -> Array:
        """(N,) distance of each point to the nearest edge's line, positive inside and negative outside."""
        return np.asarray((self.offsets - points @ self.normals.T).min(-1))

    def distance(self, points: Array) -> Array:
        """As the base class says, but to the nearest edge's line: too small beyond corners."""
        return -self.depth(points)

    def moved(self, shift: Array) -> Self:
        """The same polygon shifted by (2,), in length."""
        return replace(self, corners=self.corners + shift)


@dataclass(frozen=True)
class ObstacleRanges:
    """How obstacles are drawn: turned boxes and right-angled triangles, apart from each other and the box's sides.

    Args:
        number: Least and most of them.
        size: Least and largest width and height before turning, in length.
        gap: Least distance between their circumcircles, and from these to the box's sides, in length.

    Raises:
        ConfigError: if a range is empty or a value is out of range.
    """

    number: tuple[int, int]
    size: tuple[float, float]
    gap: float

    def __post_init__(self) -> None:
        check(0 <= self.number[0] <= self.number[1], f"obstacles.number = {list(self.number)} needs least and most.")
        check(0 < self.size[0] <= self.size[1], f"obstacles.size = {list(self.size)} needs least and largest.")
        check(self.gap >= 0, f"obstacles.gap = {self.gap} must not be negative.")

    def max_particles(self, spacing: float) -> int:
        """Upper bound of their dummy particles."""
        return self.number[1] * LAYERS * math.ceil(4 * self.size[1] / spacing)

    def draw(self, box: tuple[Interval, Interval], rng: np.random.Generator) -> tuple[PolygonObstacle, ...]:
        """Random obstacles within a box.

        Raises:
            ConfigError: if no arrangement fits into the box.
        """
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
