"""A mixture of presets: each trajectory is drawn from one of them, as it is or with cells, times, walls … of its own.

All trajectories have one domain and one time between frames, whatever they were simulated with. A trajectory that is
simulated at s times the time between frames is recorded as one at the usual time: its velocities are s times, its
gravity s² times as large, which its attribute `gravity` states. The volume of its particles is the attribute
`particle_volume`. Walls within the box are recorded as particles that do not move.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from nmpm.errors import ConfigError, DataError
from nmpm.scene import Interval, Scene
from nmpm.sim.mpm.layouts import MpmBlockRanges, RampRanges, SimulatedRamp
from nmpm.sim.mpm.preset import MpmPreset
from nmpm.sim.preset import BOUNDARY, Preset
from nmpm.sim.state import Array, InitialState, Layout, Progress, SimulatedTrajectory, check, check_numbers

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


_ATTEMPTS = 20


@dataclass(frozen=True)
class Part:
    """A preset, and its share of the trajectories."""

    share: float
    preset: MpmPreset

    def __post_init__(self) -> None:
        check_numbers(self, "parts.", positive=("share",))
        is_flat = isinstance(self.preset, MpmPreset) and self.preset.dim == 2
        check(is_flat, "parts.preset must be a preset of the material point method in two dimensions, or its name.")


@dataclass(frozen=True)
class MixtureState(InitialState):
    """A state of a mixture, its velocity and gravity as they are recorded.

    Args:
        variant: What simulates it.
        time: Its time between frames, as a multiple of the mixture's.
        substeps: Of the mixture that drew it; one with fewer simulates it with as many fewer, where they are stable.
        static: (M, D) the particles that do not move.
    """

    variant: MpmPreset = dataclasses.field(kw_only=True)
    time: float = dataclasses.field(kw_only=True)
    substeps: int = dataclasses.field(kw_only=True)
    static: Array = dataclasses.field(kw_only=True)


@dataclass(frozen=True, kw_only=True)
class MpmMixture(Preset):
    """Presets of the material point method in two dimensions, mixed and varied; `presets/universal.yaml` comments it.

    `box` is how far particles get, `spacing` that of the particles obstacles are made of, and `substeps` are those of
    a frame at the usual time on cells as large; each trajectory takes at least as many as are stable. Further:

    Args:
        parts: The presets; where they are and how long their frames are is the mixture's.
        variation: How their scenes are varied.
        coarser: Size of the simulator's cells, as a multiple of those that the scenes are drawn for.

    Raises:
        ConfigError: if the numbers contradict each other.
    """

    solver: ClassVar[str] = "mls_mpm_mixture"
    generator: ClassVar[str] = MpmPreset.generator
    revision: ClassVar[int] = MpmPreset.revision

    parts: tuple[Part, ...]
    variation: Variation
    coarser: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check(len(self.box) == len(self.domain) == len(self.gravity) == 2, "A mixture has two axes.")
        check(bool(self.parts), "parts is empty.")
        check(self.coarser in (1, 2, 4), f"coarser = {self.coarser} must be 1, 2 or 4.")

    def draw(self, seed: int) -> MixtureState:
        rng = np.random.default_rng(seed)
        for _ in range(_ATTEMPTS):
            variant, time = self._draw_variant(rng)
            try:
                start = variant.draw(int(rng.integers(2**62)))
            except ConfigError as error:  # no room for these blocks; others may fit
                reason = error
                continue
            return self._recorded(start, variant, time)
        raise reason

    def _draw_variant(self, rng: np.random.Generator) -> tuple[MpmPreset, float]:
        """The preset of a trajectory, and its time between frames as a multiple of the mixture's."""
        shares, varied = np.array([part.share for part in self.parts]), self.variation
        part = self.parts[int(rng.choice(len(shares), p=shares / shares.sum()))].preset
        if rng.random() >= varied.share:
            return self._variant(part, 1.0, fit_box(part, part.spacing, self._sides(part))), 1.0
        moved = varied.inset * rng.random((2, 2)) * (rng.random((2, 2)) < varied.narrowed)
        sides = [(low + a, high - b) for (low, high), (a, b) in zip(self.box, moved.tolist(), strict=True)]
        time, spacing = (math.exp(rng.uniform(*np.log(each))) for each in (varied.time, varied.spacing))
        box = fit_box(part, spacing, sides)
        changes: dict[str, Any] = {
            "gravity": varied.draw_gravity(part.gravity, rng),
            "gravity_turn": 0.0,
            "blocks": varied.draw_blocks(part, box, rng),
            "ramps": varied.draw_ramps(box.cell, rng),
        }
        return self._variant(part, time, box, **changes), time

    def _sides(self, part: MpmPreset) -> list[Interval]:
        """How far particles of a part that is not varied get: up to its own wall layer in the domain, within `box`."""
        layer = part.reach[0][0] - part.domain[0][0]
        pairs = zip(self.domain, self.box, strict=True)
        return [(max(outer[0] + layer, low), min(outer[1] - layer, high)) for outer, (low, high) in pairs]

    def _variant(self, part: MpmPreset, time: float, box: FittedBox, **changes: Any) -> MpmPreset:
        least = math.ceil(self.substeps * time * self.spacing / box.cell - 1e-9)
        facts = {"frame_dt": time * self.frame_dt, "domain": self.domain, "cells": box.cells}
        return part._with_stable_substeps(least, spacing=box.spacing, box=box.sides, **facts, **changes)

    def _recorded(self, start: InitialState, variant: MpmPreset, time: float) -> MixtureState:
        """A variant's state with velocity and gravity as they are recorded."""
        bars = (*start.obstacles_of(SimulatedRamp), *wall_bars(self.box, variant.reach))
        return MixtureState(
            start.position,
            time * start.velocity,
            tuple(time**2 * pull for pull in start.gravity or variant.gravity),
            start.counts,
            start.obstacles,
            variant=variant,
            time=time,
            substeps=self.substeps,
            static=np.concatenate([np.empty((0, 2)), *(bar.particles(self.spacing) for bar in bars)]),
        )

    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        if not isinstance(start, MixtureState):
            raise DataError(f"The preset {self.name} simulates only states that it has drawn: each has its own solver.")
        variant, time = start.variant, start.time
        if self.substeps != start.substeps:
            variant = variant._with_stable_substeps(math.ceil(variant.substeps * self.substeps / start.substeps))
        if self.coarser > 1:
            variant = variant.coarsened(self.coarser)
        gravity = tuple(pull / time**2 for pull in start.gravity or self.gravity)
        state = InitialState(start.position, start.velocity / time, gravity, start.counts, start.obstacles)
        made = variant.simulate_from(state, frames, progress)
        moving = made.particle_type != BOUNDARY
        still = np.broadcast_to(start.static.astype(np.float32), (frames + 1, *start.static.shape))
        types = np.concatenate([made.particle_type[moving], np.full(len(start.static), BOUNDARY)])
        facts = {"gravity": np.array(start.gravity), "particle_volume": variant.spacing**2}
        position = np.concatenate([made.position[:, moving], still], axis=1)
        return SimulatedTrajectory(position, types, made.attributes | facts)

    @property
    def scene(self) -> Scene:
        materials = self._materials
        densities = tuple(materials[name] for name in self.type_names.values() if name in materials)
        return dataclasses.replace(super().scene, gravity=None, gravity_varies=True, densities=densities)

    @property
    def _materials(self) -> dict[str, float]:
        """Density of each material by name."""
        return {kind.name: kind.density for part in self.parts for kind in part.preset.materials}

    @property
    def type_names(self) -> dict[int, str]:
        kinds = {kind.particle_type: kind.name for part in self.parts for kind in part.preset.materials}
        return dict(sorted(kinds.items())) | {BOUNDARY: "boundary"}

    @property
    def max_particles(self) -> int:
        moving = max(self.variation.particles, *(part.preset.blocks.particles[1] for part in self.parts))
        return moving + math.ceil(1.5 * area(self.domain) / self.spacing**2)

    @property
    def stable_substeps(self) -> int:
        """1: each trajectory takes as many as are stable anyway."""
        return 1

    @property
    def _layouts(self) -> Mapping[str, Layout]:
        return {}

    def varied(self, *, speed: float = 1.0, gravity: float = 1.0) -> Self:
        return self._with_parts(lambda preset: preset.varied(speed=speed, gravity=gravity))

    def widened(self, times: int) -> Self:
        box, domain, _ = self._widened_sides(times, self.spacing)
        variation = dataclasses.replace(self.variation, particles=times * self.variation.particles)
        return self._with_parts(lambda preset: preset.widened(times), box=box, domain=domain, variation=variation)

    def coarsened(self, factor: int) -> Self:
        check(MULTIPLE % factor == 0, f"The cells of {self.name} cannot be coarsened {factor} times.")
        return dataclasses.replace(self, coarser=factor * self.coarser)

    def _with_parts(self, change: Callable[[MpmPreset], MpmPreset], **changes: Any) -> Self:
        parts = tuple(Part(part.share, change(part.preset)) for part in self.parts)
        return dataclasses.replace(self, parts=parts, **changes)

    def to_dict(self) -> dict[str, Any]:
        parts = [{"share": part.share, "preset": part.preset.to_dict()} for part in self.parts]
        return super().to_dict() | {"parts": parts}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        if "parts" not in plain:
            return super().from_dict(plain)
        section = plain["parts"]
        check(isinstance(section, list | tuple), "parts must list a share and a preset each.")
        return super().from_dict({**plain, "parts": [_with_preset(entry) for entry in section]})


def _with_preset(entry: Any) -> Any:
    """An entry of `parts` with its preset read, if it is described."""
    described = entry.get("preset") if isinstance(entry, Mapping) else None
    if not isinstance(described, Mapping):
        return entry
    facts = {key: value for key, value in described.items() if key != "solver"}
    return {**entry, "preset": MpmPreset.from_dict(facts)}
