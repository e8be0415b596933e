"""Initial states of the material point method: rectangular blocks of particles, and ramps.

Each block has one velocity. Ramps are slanted bars, slabs in three dimensions, in the box that do not move, after the
setting of DeepMind's WaterRamps and SandRamps scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.state import Array, BlockRanges, InitialState, Obstacle, check, check_numbers, lattice

_BLOCK_ATTEMPTS = 10_000
_RESTARTS = 20
_RAMP_ATTEMPTS = 500
_OUTLINE = 96  # points on a bar's outline by which its distance from others is judged
_SURFACE = 12  # points along each side of a slab, likewise


Extent = tuple[Array, Array]
"""Lower and upper corner of a block, (D,) each."""


@dataclass(frozen=True)
class MpmBlockRanges(BlockRanges):
    """How blocks are drawn: `BlockRanges`, and their height in the box.

    Args:
        height: Least and largest height of a block above the box's bottom, as far as the gap allows; anywhere if None.
    """

    height: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height is not None:
            check_numbers(self, "blocks.", at_least_0=("height",))

    def draw(
        self, box: tuple[Interval, ...], spacing: float, materials: int, rng: np.random.Generator
    ) -> tuple[InitialState, list[Extent]]:
        """Random blocks within a box, sorted by material, which they take in turn; and their extents.

        Raises:
            ConfigError: if no arrangement of blocks fits into the box.
        """
        # Drawn once: more blocks fit less often, and drawing anew would leave mostly single ones.
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_BLOCK_ATTEMPTS):
            lattices = self._draw_lattices(number, len(box), rng)
            lows = self._place(box, spacing, lattices, rng)
            if lows is not None:
                break
        else:
            raise ConfigError(
                f"No room for {self.particles} particles in blocks within {box}: "
                "take fewer particles, a smaller spacing or a smaller gap."
            )
        kinds = _draw_materials(number, materials, rng)
        speeds = [rng.uniform(-self.speed, self.speed, len(box)) for _ in range(number)]
        positions, velocities, extents, counts = [], [], [], [0] * materials
        for block in sorted(range(number), key=kinds.__getitem__):
            low, shape = lows[block], lattices[block]
            shift = rng.uniform(-self.jitter, self.jitter, (math.prod(shape), len(shape)))
            positions.append(lattice(low, shape, spacing, shift))
            velocities.append(np.broadcast_to(speeds[block], shift.shape))
            extents.append((low, low + spacing * np.array(shape)))
            counts[kinds[block]] += len(shift)
        return InitialState(np.concatenate(positions), np.concatenate(velocities), counts=tuple(counts)), extents

    def _draw_lattices(self, number: int, dim: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
        """Particles of each block along each axis, drawn until their sum is within `particles`."""
        low, high = self.particles
        for _ in range(_BLOCK_ATTEMPTS):
            shares = self.share + (1 - number * self.share) * rng.dirichlet(np.ones(number))
            sizes = shares * rng.uniform(low, high)
            lattices = _block_sides(sizes, self.aspect, dim, rng)
            if low <= int(lattices.prod(axis=1).sum()) <= high:
                return [tuple(map(int, shape)) for shape in lattices]
        raise ConfigError(f"No blocks have {self.particles} particles together: widen blocks.particles.")

    def _place(
        self,
        box: tuple[Interval, ...],
        spacing: float,
        lattices: list[tuple[int, ...]],
        rng: np.random.Generator,
    ) -> list[Array] | None:
        """Lower corners of the blocks, or None if one does not fit or two come too close."""
        gap = self.gap
        box_low, box_high = np.array(box).T
        placed: list[Extent] = []
        for shape in lattices:
            side = spacing * np.array(shape)
            first, last = box_low + gap, box_high - gap - side
            if self.height is not None:
                lowest, highest = self.height
                first[1], last[1] = max(first[1], box_low[1] + lowest), min(last[1], box_low[1] + highest)
            if np.any(last < first):
                return None
            low = rng.uniform(first, last)
            if any(np.all((low < high + gap) & (other < low + side + gap)) for other, high in placed):
                return None
            placed.append((low, low + side))
        return [low for low, _ in placed]


def _draw_materials(blocks: int, materials: int, rng: np.random.Generator) -> list[int]:
    """The material of each block: all of them in turn, in random order."""
    rounds = [rng.permutation(materials) for _ in range(-(-blocks // materials))]
    return [int(kind) for kind in np.concatenate(rounds)[:blocks]]


def _block_sides(sizes: Array, aspect: tuple[float, float], dim: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """(B, D) particles along each axis of blocks with about `sizes` (B,) particles: width, height and depth."""
    # Height over width, and in three dimensions depth over width after it.
    least, largest = np.log(aspect)
    ratios = [np.exp(rng.uniform(least, largest, len(sizes))) for _ in range(dim - 1)]
    width = np.maximum(1, np.rint((sizes / np.prod(ratios, axis=0)) ** (1 / dim)))
    depth = [np.maximum(1, np.rint(width * ratio)) for ratio in ratios[1:]]
    height = np.maximum(1, np.rint(sizes / np.prod([width, *depth], axis=0)))
    return np.stack([width, height, *depth], axis=1).astype(np.int64)


@dataclass(frozen=True)
class SimulatedRamp(Obstacle):
    """A bar: a rectangle about a centre (x, y), its longer side turned by an angle from the x axis, in radians.

    In three dimensions, with a centre (x, y, z), it has a level width, and is turned from the x to the z axis as well.
    """

    centre: tuple[float, ...]
    length: float
    thickness: float
    angle: float
    width: float = 0.0
    turn: float = 0.0

    @property
    def _axes(self) -> Array:
        """(D, D) unit vectors along and across the bar, and along its width, as rows."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        if len(self.centre) == 2:
            return np.array([[cos, sin], [-sin, cos]])
        x, z = math.cos(self.turn), math.sin(self.turn)
        return np.array([[cos * x, sin, cos * z], [-sin * x, cos, -sin * z], [-z, 0.0, x]])

    @property
    def _sides(self) -> tuple[float, ...]:
        return (self.length, self.thickness, self.width)[: len(self.centre)]

    @property
    def _half(self) -> Array:
        return np.array(self._sides) / 2

    def distance(self, points: Array) -> Array:
        """(K,) signed distance of points (K, D) from the bar, negative inside."""
        beyond = np.abs((points - np.array(self.centre)) @ self._axes.T) - self._half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return np.asarray(outside + np.minimum(beyond.max(axis=-1), 0.0))

    def moved(self, shift: Array) -> Self:
        """The same bar shifted by (D,), in length."""
        return replace(self, centre=tuple(x + float(by) for x, by in zip(self.centre, shift, strict=True)))

    def particles(self, spacing: float) -> Array:
        """(M, D) a lattice that fills the bar, parallel to its sides, about `spacing` apart."""
        numbers = ((side, max(1, round(side / spacing))) for side in self._sides)
        places = [(np.arange(number) + 0.5) / number * side - side / 2 for side, number in numbers]
        return self._turned(np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, len(places)))

    def outline(self) -> Array:
        """(K, D) points all along the sides, corners included; of a slab also inside."""
        if len(self.centre) == 3:
            unit = np.stack(np.meshgrid(*[np.linspace(-1, 1, _SURFACE)] * 3, indexing="ij"), axis=-1)
            return self._turned(unit.reshape(-1, 3) * self._half)
        corners = self._half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
        along = np.linspace(0, 4, _OUTLINE + 1)[:-1]
        return self._turned(np.stack([np.interp(along, np.arange(5), corners[:, axis]) for axis in range(2)], axis=-1))

    def _turned(self, local: Array) -> Array:
        """Points (K, D) along the bar's axes from its centre, in the box."""
        return np.asarray(np.array(self.centre) + local @ self._axes)


@dataclass(frozen=True)
class RampRanges:
    """How the ramps of a scene are drawn; lengths in metres.

    Args:
        number: Least and most of them.
        length: Least and largest length.
        thickness: Of all.
        angle: Least and largest slope, in degrees; to the left or to the right with equal chances.
        gap: Least distance between them, from the box's sides, and from blocks.
        width: Least and largest level width, in three dimensions, where ramps face any direction.
    """

    number: tuple[int, int]
    length: tuple[float, float]
    thickness: float
    angle: tuple[float, float]
    gap: float
    width: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_numbers(self, "ramps.", positive=("length", "thickness"), at_least_0=("number", "angle", "gap"))
        if self.width is not None:
            check_numbers(self, "ramps.", positive=("width",))
        check(self.angle[1] <= 90, f"ramps.angle = {list(self.angle)} is not within 0 and 90.")
        check(self.thickness <= self.length[0], f"ramps.thickness = {self.thickness} is more than the length.")

    def max_particles(self, spacing: float) -> int:
        """Upper bound of the particles that the ramps of a scene are made of."""
        sides = self.length[1], self.thickness, *(() if self.width is None else self.width[1:])
        of_one: int = math.prod(max(1, round(side / spacing)) for side in sides)
        return self.number[1] * of_one

    def draw(
        self, box: tuple[Interval, ...], occupied: Sequence[Extent], rng: np.random.Generator
    ) -> tuple[SimulatedRamp, ...]:
        """Random ramps within a box, clear of blocks; ConfigError if no arrangement fits into it."""
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_RESTARTS):
            placed = self._place(number, box, occupied, rng)
            if placed is not None:
                return placed
        raise ConfigError(f"No room for {number} ramps of ramps.length = {list(self.length)} within {box}.")

    def _place(
        self,
        number: int,
        box: tuple[Interval, ...],
        occupied: Sequence[Extent],
        rng: np.random.Generator,
    ) -> tuple[SimulatedRamp, ...] | None:
        """Bars placed one after the other, or None if the first ones leave no room for the others."""
        low, high = np.array(box).T
        placed: list[SimulatedRamp] = []
        for _ in range(_RAMP_ATTEMPTS):
            if len(placed) == number:
                return tuple(placed)
            angle = math.radians(rng.uniform(*self.angle)) * (1 if rng.random() < 0.5 else -1)
            centre = tuple(rng.uniform(low, high).tolist())
            drawn = SimulatedRamp(centre, float(rng.uniform(*self.length)), self.thickness, angle)
            if self.width is not None:
                drawn = replace(drawn, width=rng.uniform(*self.width), turn=rng.uniform(0, math.pi))
            outline = drawn.outline()
            inside = np.all((outline >= low + self.gap) & (outline <= high - self.gap))
            clear = all(other.distance(outline).min() >= self.gap for other in placed)
            if inside and clear and not any(_too_close(drawn, corners, self.gap) for corners in occupied):
                placed.append(drawn)
        return None


def _too_close(ramp: SimulatedRamp, corners: Extent, gap: float) -> bool:
    """Whether a ramp comes closer to a block than the gap."""
    low, high = corners
    beyond = np.maximum(np.maximum(low - ramp.outline(), ramp.outline() - high), 0.0)
    nearest = np.linalg.norm(beyond, axis=1).min()
    # Corners of the block may come nearer than any point of the outline, or lie within the bar.
    points = np.stack(np.meshgrid(*np.stack([low, high], axis=-1), indexing="ij"), axis=-1).reshape(-1, len(low))
    return bool(min(nearest, ramp.distance(points).min()) < gap)


def distance_to_ramps(ramps: tuple[SimulatedRamp, ...], points: Array) -> Array:
    """(K,) signed distance of points (K, D) from the nearest bar, negative inside; infinite where there is none."""
    nearest = np.full(len(points), np.inf)
    for ramp in ramps:
        nearest = np.minimum(nearest, ramp.distance(points))
    return nearest


def fit_ramps(points: Array, thickness: float, spacing: float) -> tuple[SimulatedRamp, ...]:
    """The bars, of a thickness and in two dimensions, that particles (M, 2) of `SimulatedRamp.particles` fill.

    Raises:
        ConfigError: if particles that touch fill no bar.
    """
    points = np.asarray(points, np.float64)
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), 1.6 * spacing)
    number, label = connected_components(near, directed=False)
    return tuple(_fit_ramp(points[label == each], thickness, spacing) for each in range(number))


def _fit_ramp(points: Array, thickness: float, spacing: float) -> SimulatedRamp:
    """The bar that particles (K, 2) fill, its longer side along their principal axis."""
    centre = points.mean(axis=0)
    along = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    across = max(1, round(thickness / spacing))
    number, extent = len(points) // across, np.ptp((points - centre) @ along)
    length = extent * number / (number - 1) if number > 1 else spacing
    ramp = SimulatedRamp(tuple(centre.tolist()), float(length), thickness, math.atan2(along[1], along[0]))
    filled = ramp.particles(spacing)
    if len(filled) != len(points) or cKDTree(points).query(filled)[0].max() > spacing / 4:
        raise ConfigError(
            f"The {len(points)} obstacle particles about {centre.round(3).tolist()} are no bar of the thickness"
            f" {thickness:g}, the only obstacle of this simulator."
        )
    return ramp
