"""Initial states: a relaxed column in the corner, or thrown blocks among obstacles, and the solids around them."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.materials.base import Array
from nmpm.sim.preset import require
from nmpm.sim.sph.relaxation import relaxed
from nmpm.sim.sph.walls import LAYERS, Obstacle
from nmpm.sim.thrown import Thrown

Box = tuple[Interval, Interval]

_ATTEMPTS = 10_000
_STARTS = 50
_PLACES = 500


class Start(abc.ABC):
    """How the water's initial state is drawn."""

    @abc.abstractmethod
    def draw(
        self, box: Box, spacing: float, obstacles: tuple[Obstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Positions and velocities, (N, 2) each, of particles in the box and in no obstacle.

        Raises:
            ConfigError: if no arrangement is found, so crowded is the box.
        """

    @abc.abstractmethod
    def most_particles(self, spacing: float) -> int:
        """No state has more particles than that."""


@dataclass(frozen=True)
class Column(Start):
    """A column of water at rest in the lower left corner of the box, its particles strewn and then relaxed.

    Args:
        width: In length.
        height: In length.
        noise: Standard deviation of a particle's displacement off the lattice, in spacings.
        relaxation: Sweeps that spread the particles evenly again.

    Raises:
        ConfigError: if a number is out of range.
    """

    width: float
    height: float
    noise: float
    relaxation: int

    def __post_init__(self) -> None:
        require(self.width > 0 and self.height > 0, "column.width and column.height must be positive.")
        require(self.noise >= 0 and self.relaxation >= 0, "column.noise and column.relaxation must not be negative.")

    def lattice(self, spacing: float) -> tuple[int, int]:
        """Particles along x and y."""
        return round(self.width / spacing), round(self.height / spacing)

    def most_particles(self, spacing: float) -> int:
        return math.prod(self.lattice(spacing))

    def draw(
        self, box: Box, spacing: float, obstacles: tuple[Obstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        shape = self.lattice(spacing)
        low = np.array([axis[0] for axis in box])
        high = low + spacing * np.array(shape)
        strewn = _lattice(low, shape, spacing) + rng.normal(scale=self.noise * spacing, size=(math.prod(shape), 2))
        column = ((low[0], high[0]), (low[1], high[1]))
        position = relaxed(strewn, column, spacing, self.relaxation)
        free = _free(position, obstacles, spacing)
        return position[free], np.zeros_like(position[free])


@dataclass(frozen=True)
class Throw(Thrown, Start):
    """Rectangular blocks of water, thrown; what of them would be inside of obstacles is left out."""

    def draw(
        self, box: Box, spacing: float, obstacles: tuple[Obstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_ATTEMPTS):
            blocks = self._arranged(box, spacing, number, rng)
            if blocks is not None:
                break
        else:
            raise ConfigError(f"No room for blocks.particles = {list(self.particles)} in {number} blocks within {box}.")
        position, velocity = [], []
        for low, shape in blocks:
            points = _lattice(low, shape, spacing)
            points += spacing * rng.uniform(-self.jitter, self.jitter, points.shape)
            position.append(points[_free(points, obstacles, spacing)])
            velocity.append(np.broadcast_to(rng.uniform(-self.speed, self.speed, 2), position[-1].shape))
        return np.concatenate(position), np.concatenate(velocity)

    def most_particles(self, spacing: float) -> int:  # noqa: ARG002
        return self.particles[1]

    def _arranged(
        self, box: Box, spacing: float, number: int, rng: np.random.Generator
    ) -> list[tuple[Array, tuple[int, int]]] | None:
        """Lower corner and lattice of each block, or None if they leave the box, meet, or are too few or many."""
        sizes = self.share + (1 - number * self.share) * rng.dirichlet(np.ones(number))
        sizes *= rng.uniform(*self.particles)
        aspects = np.exp(rng.uniform(math.log(self.aspect[0]), math.log(self.aspect[1]), number))
        shapes = np.maximum(1, np.rint(np.sqrt(np.stack([sizes / aspects, sizes * aspects], -1)))).astype(int)
        if not self.particles[0] <= shapes.prod(-1).sum() <= self.particles[1]:
            return None
        box_low, box_high = np.array(box).T
        sides = spacing * shapes
        first, last = box_low + self.gap, box_high - self.gap - sides
        if np.any(first > last):
            return None
        lows = rng.uniform(first, last)
        for a in range(number):
            for b in range(a):
                if np.all((lows[a] < lows[b] + sides[b] + self.gap) & (lows[b] < lows[a] + sides[a] + self.gap)):
                    return None
        return [(low, (int(c), int(r))) for low, (c, r) in zip(lows, shapes, strict=True)]


@dataclass(frozen=True)
class Strewn:
    """Obstacles: turned boxes and ramps (right-angled triangles), apart from each other and from the box's sides.

    Args:
        number: Least and most of them.
        size: Least and largest width and height before turning, in length.
        gap: Least distance between their circumcircles, and from these to the box's sides, in length.

    Raises:
        ConfigError: if a range is empty or out of reach.
    """

    number: tuple[int, int]
    size: tuple[float, float]
    gap: float

    def __post_init__(self) -> None:
        require(0 <= self.number[0] <= self.number[1], f"obstacles.number = {list(self.number)} needs least and most.")
        require(0 < self.size[0] <= self.size[1], f"obstacles.size = {list(self.size)} needs least and largest.")
        require(self.gap >= 0, f"obstacles.gap = {self.gap} must not be negative.")

    def most_particles(self, spacing: float) -> int:
        """Dummy particles, at most."""
        return self.number[1] * LAYERS * math.ceil(4 * self.size[1] / spacing)

    def draw(self, box: Box, rng: np.random.Generator) -> tuple[Obstacle, ...]:
        """Some obstacles.

        Raises:
            ConfigError: if no arrangement is found, so crowded is the box.
        """
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_STARTS):
            placed = self._placed(number, box, rng)
            if placed is not None:
                return placed
        raise ConfigError(f"No room for {number} obstacles of obstacles.size = {list(self.size)} within {box}.")

    def _placed(self, number: int, box: Box, rng: np.random.Generator) -> tuple[Obstacle, ...] | None:
        """Obstacles placed one after the other, or None if the first ones leave no room for the others."""
        low, high = np.array(box).T
        placed: list[tuple[Array, float, Obstacle]] = []
        for _ in range(_PLACES):
            if len(placed) == number:
                return tuple(obstacle for _, _, obstacle in placed)
            corners = _turned(rng.uniform(*self.size, 2), rng)
            radius = float(np.linalg.norm(corners, axis=1).max())
            keep = radius + self.gap
            if np.any(high - low < 2 * keep):
                continue
            centre = rng.uniform(low + keep, high - keep)
            if all(np.linalg.norm(centre - other) >= keep + size for other, size, _ in placed):
                placed.append((centre, radius, Obstacle(centre + corners)))
        return None


def _turned(size: Array, rng: np.random.Generator) -> Array:
    """Corners of a box, or of the triangle that three of them make, about its centre and turned by any angle."""
    corners = 0.5 * size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    count, angle = rng.integers(3, 5), rng.uniform(0, 2 * math.pi)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(corners[:count] @ np.array([[cos, sin], [-sin, cos]]))


def _free(points: Array, obstacles: tuple[Obstacle, ...], spacing: float) -> NDArray[np.bool_]:
    """Which points (N, 2) are no nearer to an obstacle than half a spacing."""
    free = np.ones(len(points), np.bool_)
    for obstacle in obstacles:
        free &= obstacle.depth(points) < -0.5 * spacing
    return free


def _lattice(low: Array, shape: tuple[int, int], spacing: float) -> Array:
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2)
    return np.asarray(low + spacing * (nodes + 0.5))
