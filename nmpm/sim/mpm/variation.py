"""How the scenes of a mixture vary: boxes, gravity, obstacles and blocks that are drawn for each trajectory."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nmpm.scene import Interval
from nmpm.sim.mpm.layouts import MpmBlockRanges, RampRanges, SimulatedRamp
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.state import check, check_numbers

MULTIPLE = 4
"""The simulator's cells along each axis are a multiple of it, so that grids can be coarsened."""
_THINNEST = 2.5
"""Simulator's cells across the thinnest obstacle: material on its two sides shares no nodes."""
_LEAST = 1e-6
"""Length of the thinnest wall that is recorded."""


@dataclass(frozen=True)
class Variation:
    """How a part's scenes are varied; factors and lengths are drawn for each trajectory.

    Args:
        share: Of the trajectories that are varied; the others are as their part draws them.
        spacing: Least and largest distance between particles; the simulator's cells follow it.
        time: Least and largest time between frames, as a multiple of the preset's.
        speed: Least and largest factor on the part's initial speeds.
        material: Least and largest factor on the part's amount of material.
        particles: Most particles in a scene.
        turned: Share of the varied trajectories whose gravity points anywhere.
        weak: Share of them with up to `weakest` of gravity, pointing anywhere.
        weakest: Largest factor on weak gravity.
        inset: Largest distance that a side of the box is moved inwards.
        narrowed: Chance of a side to be moved.
        open: Share of them without obstacles.
        ramps: Obstacles of the others; their `thickness` is the largest.
    """

    share: float
    spacing: tuple[float, float]
    time: tuple[float, float]
    speed: tuple[float, float]
    material: tuple[float, float]
    particles: int
    turned: float
    weak: float
    weakest: float
    inset: float
    narrowed: float
    open: float
    ramps: RampRanges

    def __post_init__(self) -> None:
        shares = ("share", "turned", "weak", "weakest", "narrowed", "open")
        check_numbers(
            self, "variation.", positive=("spacing", "time", "material", "particles"),
            at_least_0=("speed", "inset", *shares),
        )  # fmt: skip
        for key in shares:
            check(getattr(self, key) <= 1, f"variation.{key} = {getattr(self, key)} must be from 0 to 1.")
        check(self.turned + self.weak <= 1, "variation.turned and weak are more than all trajectories together.")

    def draw_gravity(self, gravity: tuple[float, ...], rng: np.random.Generator) -> tuple[float, ...]:
        """Gravity of a trajectory, for its part's."""
        kind, angle, factor = rng.random(), rng.uniform(-math.pi, math.pi), rng.uniform(0, self.weakest)
        if kind >= self.turned + self.weak:
            return gravity
        (x, y), cos, sin = gravity, math.cos(angle), math.sin(angle)
        scale = factor if kind < self.weak else 1.0
        return scale * (cos * x - sin * y), scale * (sin * x + cos * y)

    def draw_ramps(self, cell: float, rng: np.random.Generator) -> RampRanges | None:
        """Obstacles of one thickness, or none."""
        kind, thickness = rng.random(), rng.uniform(0, self.ramps.thickness)
        if kind < self.open:
            return None
        thickness = max(thickness, _THINNEST * cell)
        shortest = max(self.ramps.length[0], thickness)
        length = shortest, max(shortest, self.ramps.length[1])
        return dataclasses.replace(self.ramps, thickness=thickness, length=length)

    def draw_blocks(self, part: MpmPreset, box: FittedBox, rng: np.random.Generator) -> MpmBlockRanges:
        """Blocks anywhere in a box, that take up about as large a share of it as the part's do of its box."""
        blocks = part.blocks
        usual = area(part.box) / part.spacing**2
        factor = rng.uniform(*self.material) * area(box.sides) / box.spacing**2 / usual
        factor = min(factor, self.particles / blocks.particles[1])
        least, most = (max(1, round(factor * number)) for number in blocks.particles)
        number = max(1, blocks.number[0] - 1), blocks.number[1] + 1
        share, speed = min(blocks.share, 0.8 / number[1]), rng.uniform(*self.speed) * blocks.speed
        return dataclasses.replace(
            blocks, particles=(least, most), number=number, share=share, speed=speed, height=None
        )


@dataclass(frozen=True)
class FittedBox:
    """A box of whole cells: its sides, the cells along x and their size, and the distance between particles."""

    sides: tuple[Interval, ...]
    cells: int
    cell: float
    spacing: float


def fit_box(part: MpmPreset, spacing: float, reach: Sequence[Interval]) -> FittedBox:
    """The box of a preset in which particles get as far as `reach`, for about a spacing; its top may be lower.

    Cells stay as many spacings wide as the preset's.
    """
    (left, right), (bottom, top) = reach
    width, layer = part.cell_size / part.spacing, part.wall_layer
    columns = MULTIPLE * max(1, round(((right - left) / (width * spacing) - 2 * layer) / MULTIPLE))
    cell = (right - left) / (columns + 2 * layer)
    rows = MULTIPLE * max(1, math.floor(((top - bottom) / cell - 2 * layer) / MULTIPLE + 1e-9))
    low, floor = left + layer * cell, bottom + layer * cell
    return FittedBox(((low, low + columns * cell), (floor, floor + rows * cell)), columns, cell, cell / width)


def wall_bars(outer: Sequence[Interval], inner: Sequence[Interval]) -> Iterator[SimulatedRamp]:
    """Bars that fill the room between two boxes, one within the other."""
    (left, right), (bottom, top) = outer
    (a, b), (c, d) = inner
    for (x, y), (low, high) in (
        ((left, a), (bottom, top)),
        ((b, right), (bottom, top)),
        ((a, b), (bottom, c)),
        ((a, b), (d, top)),
    ):
        if min(y - x, high - low) > _LEAST:
            yield SimulatedRamp(((x + y) / 2, (low + high) / 2), y - x, high - low, 0.0)


def area(box: Sequence[Interval]) -> float:
    """Area of a box in two dimensions."""
    return math.prod(high - low for low, high in box)
