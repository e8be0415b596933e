"""Presets of WCSPH: a relaxed column of fluid in the corner, or moving blocks among obstacles."""

from __future__ import annotations

import abc
import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import ConfigError
from nmpm.scene import Interval
from nmpm.sim.preset import BOUNDARY, Preset
from nmpm.sim.sph import wcsph
from nmpm.sim.sph.boundary import ObstacleRanges, PolygonObstacle, SolidBoundary, box_particles
from nmpm.sim.sph.wcsph import SUPPORT, Fluid, PairLists, Pairs, SphParticles, SphStepper, WallPairs
from nmpm.sim.state import (
    Array,
    BlockRanges,
    InitialState,
    Layout,
    Progress,
    SimulatedTrajectory,
    check,
    check_numbers,
    lattice,
    record_frames,
)

Rectangle = tuple[Interval, Interval]

_ATTEMPTS = 10_000


class FluidLayout(Layout):
    """How the fluid's initial state is drawn."""

    @abc.abstractmethod
    def draw(
        self, box: Rectangle, spacing: float, obstacles: tuple[PolygonObstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Positions and velocities, (N, 2) each, of particles in the box and in no obstacle.

        Raises:
            ConfigError: if no arrangement fits into the box.
        """

    @abc.abstractmethod
    def max_particles(self, spacing: float) -> int:
        """Upper bound of a state's particles."""

    @abc.abstractmethod
    def coarsened(self, factor: int) -> Self:
        """The same fluid in particles that are `factor` times as large."""


@dataclass(frozen=True)
class Column(FluidLayout):
    """A column of fluid at rest in the lower left corner of the box; its particles are displaced and then relaxed.

    Args:
        width: In length.
        height: In length.
        noise: Standard deviation of a particle's displacement off the lattice, in spacings.
        relaxation: Sweeps that spread the particles evenly again.
    """

    width: float
    height: float
    noise: float
    relaxation: int

    def __post_init__(self) -> None:
        check_numbers(self, "column.", positive=("width", "height"), at_least_0=("noise", "relaxation"))

    def faster(self, factor: float) -> Self:  # noqa: ARG002  # (it is at rest)
        return self

    def multiplied(self, times: int) -> Self:
        return dataclasses.replace(self, width=times * self.width)

    def coarsened(self, factor: int) -> Self:  # noqa: ARG002  # (its size is given in length)
        return self

    def shape(self, spacing: float) -> tuple[int, int]:
        """Particles along x and y."""
        return round(self.width / spacing), round(self.height / spacing)

    def max_particles(self, spacing: float) -> int:
        return math.prod(self.shape(spacing))

    def draw(
        self, box: Rectangle, spacing: float, obstacles: tuple[PolygonObstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        shape = self.shape(spacing)
        low = np.array([axis[0] for axis in box])
        high = low + spacing * np.array(shape)
        displaced = lattice(low, shape, spacing) + rng.normal(scale=self.noise * spacing, size=(math.prod(shape), 2))
        column = ((low[0], high[0]), (low[1], high[1]))
        position = relax(displaced, column, spacing, self.relaxation)
        free = _clear_of(position, obstacles, spacing)
        return position[free], np.zeros_like(position[free])


@dataclass(frozen=True)
class FluidBlocks(BlockRanges, FluidLayout):
    """Rectangular blocks of fluid, each with one velocity; particles that would be inside obstacles are left out."""

    def draw(
        self, box: Rectangle, spacing: float, obstacles: tuple[PolygonObstacle, ...], rng: np.random.Generator
    ) -> tuple[Array, Array]:
        number = int(rng.integers(self.number[0], self.number[1] + 1))
        for _ in range(_ATTEMPTS):
            blocks = self._arrange(box, spacing, number, rng)
            if blocks is not None:
                break
        else:
            raise ConfigError(f"No room for blocks.particles = {list(self.particles)} in {number} blocks within {box}.")
        position, velocity = [], []
        for low, shape in blocks:
            points = lattice(low, shape, spacing)
            points += spacing * rng.uniform(-self.jitter, self.jitter, points.shape)
            position.append(points[_clear_of(points, obstacles, spacing)])
            velocity.append(np.broadcast_to(rng.uniform(-self.speed, self.speed, 2), position[-1].shape))
        return np.concatenate(position), np.concatenate(velocity)

    def max_particles(self, spacing: float) -> int:  # noqa: ARG002
        return self.particles[1]

    def coarsened(self, factor: int) -> Self:
        fewest, most = self.particles
        return dataclasses.replace(self, particles=(max(1, fewest // factor**2), max(1, most // factor**2)))

    def _arrange(
        self, box: Rectangle, spacing: float, number: int, rng: np.random.Generator
    ) -> list[tuple[Array, tuple[int, int]]] | None:
        """Lower corner and lattice of each block; None if they do not fit, meet, or are too small or large."""
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


def _clear_of(points: Array, obstacles: tuple[PolygonObstacle, ...], spacing: float) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) are no nearer to an obstacle than half a spacing."""
    free = np.ones(len(points), np.bool_)
    for obstacle in obstacles:
        free &= obstacle.distance(points) > 0.5 * spacing
    return free


# Way along the gradient of particle concentration in a sweep, in spacings squared, and its limit in spacings.
_STEP = 0.1
_LIMIT = 0.1


def relax(position: Array, box: Rectangle, spacing: float, sweeps: int) -> Array:
    """Move particles, sweep by sweep, from where they are dense to where they are not.

    A sweep shifts each by −D ∇C, where C is the concentration Σ V W (Lind, Xu, Stansby & Rogers 2012, equation 24),
    which is what a constant background pressure does in Adami, Hu & Adams (2013).
    Particles outside of the box are moved to its sides first.
    """
    boundary = SolidBoundary(box, (), spacing)
    lists = PairLists(boundary.position, SUPPORT * spacing)
    x, y = np.ascontiguousarray(position.T)
    identity, still = np.arange(len(x)), np.zeros_like(x)
    for _ in range(sweeps):
        boundary.clamp(x, y, still, still)
        order, starts = lists.sort_by_cell(x, y)
        x, y, identity = x[order], y[order], identity[order]
        pairs, wall_pairs = lists.near(x, y, starts)
        wcsph.pair_geometry(np.stack([x, y]), pairs, spacing)
        wcsph.wall_geometry(np.stack([x, y]), lists.wall_x, lists.wall_y, wall_pairs, spacing)
        shift = _concentration_gradient(pairs, wall_pairs, len(x), spacing)
        shift *= -_STEP * spacing**2
        shift *= np.minimum(1.0, _LIMIT * spacing / np.maximum(np.hypot(*shift), 1e-30))
        x, y = x + shift[0], y + shift[1]
    boundary.clamp(x, y, still, still)
    spread = np.empty((len(x), 2))
    spread[identity] = np.stack([x, y], -1)
    return spread


def _concentration_gradient(pairs: Pairs, walls: WallPairs, count: int, spacing: float) -> Array:
    """(2, N) gradient of the concentration, from pairs of particles and from pairs with the walls."""
    area = spacing**2
    gradient = []
    for d, wall_d in ((pairs.dx, walls.dx), (pairs.dy, walls.dy)):
        weights = pairs.f * d * area
        inner = np.bincount(pairs.first, weights, count) - np.bincount(pairs.second, weights, count)
        gradient.append(inner + np.bincount(walls.first, walls.f * wall_d * area, count))
    return np.stack(gradient)


WATER = 5
"""Type id of the particles that flow, as in DeepMind's scenes."""

CFL_LIMITS = {"sound": 0.4, "viscosity": 0.125, "gravity": 0.25}
"""Longest step, as a part of h / c, of h² / ν and of √(h / g) (Adami, Hu & Adams 2012, equations 19 to 21).

The paper takes 0.25 of h / (c + speed); with density from the velocity just updated, the dam break runs to its end
at 0.42 too.
"""


@dataclass(frozen=True, kw_only=True)
class SphPreset(Preset):
    """A family of scenes of WCSPH; `presets/dambreak2d.yaml` and `presets/wbcsph.yaml` comment every entry.

    Arguments beside those of `Preset`:

    Args:
        fluid: Its parameters.
        column: The initial state, if it is a column at rest.
        blocks: The initial state, if it is moving blocks.
        obstacles: How obstacles are drawn; none if left out.

    Raises:
        ConfigError: if the numbers contradict each other or a step is too long to be stable.
    """

    solver: ClassVar[str] = "wcsph"
    generator: ClassVar[str] = "WCSPH"
    revision: ClassVar[int] = 1

    box: tuple[Interval, Interval]
    domain: tuple[Interval, Interval]
    gravity: tuple[float, float]
    fluid: Fluid
    column: Column | None = None
    blocks: FluidBlocks | None = None
    obstacles: ObstacleRanges | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        (left, right), (bottom, top) = self.box
        check((self.column is None) != (self.blocks is None), "give either column or blocks, as the initial state.")
        if self.column is not None:
            columns, rows = self.column.shape(self.spacing)
            fits = columns * self.spacing <= right - left + 1e-9 and rows * self.spacing <= top - bottom + 1e-9
            check(fits and columns * rows > 0, f"column = {self.column} does not fit in box = {self.box}.")
        for cause, least in self._substep_bounds.items():
            check(
                self.substeps >= least,
                f"substeps = {self.substeps} are too few for {cause}: take at least {least}, or a larger spacing.",
            )

    @property
    def layout(self) -> FluidLayout:
        """How the initial state is drawn."""
        return next(iter(self._layouts.values()))

    @property
    def _layouts(self) -> dict[str, FluidLayout]:
        layouts = {"column": self.column, "blocks": self.blocks}
        return {key: layout for key, layout in layouts.items() if layout is not None}

    @property
    def _substep_bounds(self) -> dict[str, int]:
        """Fewest steps of a frame that are stable, by cause."""
        h, strength = self.spacing, math.hypot(*self.gravity)
        longest = {
            "sound": h / self.fluid.speed_of_sound,
            "viscosity": h**2 / max(self.fluid.kinematic_viscosity(h), 1e-300),
            "gravity": math.sqrt(h / max(strength, 1e-300)),
        }
        return {cause: math.ceil(self.frame_dt / (CFL_LIMITS[cause] * dt) - 1e-9) for cause, dt in longest.items()}

    @property
    def stable_substeps(self) -> int:
        """Fewest substeps of a frame that are stable, by `CFL_LIMITS`.

        They hold while the flow is slower than sound, which is ten times the fastest flow in the shipped presets.
        """
        return max(self._substep_bounds.values())

    def widened(self, times: int) -> SphPreset:
        """Scenes in a domain so many times as wide; a column becomes as many times as wide, too."""
        changes: dict[str, Any] = {key: layout.multiplied(times) for key, layout in self._layouts.items()}
        changes["box"], changes["domain"], _ = self._widened_sides(times, self.spacing)
        return dataclasses.replace(self, **changes)

    def coarsened(self, factor: int) -> SphPreset:
        """The same scenes in particles `factor` times as wide apart, with `stable_substeps` substeps.

        The particles are other ones, `factor`² times fewer: trajectories can be compared as fields, not one by one.
        Artificial viscosity grows with the spacing.

        Raises:
            ConfigError: if the scene has no room for particles of that size.
        """
        layouts = {key: layout.coarsened(factor) for key, layout in self._layouts.items()}
        return self._with_stable_substeps(1, spacing=factor * self.spacing, **layouts)

    def draw(self, seed: int) -> InitialState:
        rng = np.random.default_rng(seed)
        gravity = self._draw_gravity(rng)
        obstacles = () if self.obstacles is None else self.obstacles.draw(self.box, rng)
        position, velocity = self.layout.draw(self.box, self.spacing, obstacles, rng)
        return InitialState(position, velocity, gravity, (len(position),), obstacles)

    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        particles, stepper = self._prepare(start)
        boundary, deviations = stepper.boundary, [0.0]

        def advance(frame: int) -> Array:
            deviations.append(stepper.advance_frame(particles, self.substeps, frame))
            return particles.position

        walls = boundary.position[boundary.visible]
        position = record_frames(particles.position, walls, frames, advance, progress)
        particle_type = np.repeat([WATER, BOUNDARY], [len(start.position), len(walls)]).astype(np.int64)
        attributes = {
            "gravity": stepper.gravity, "held_back": stepper.held_back, "density_deviation": max(deviations)
        }  # fmt: skip
        return SimulatedTrajectory(position, particle_type, attributes)

    def stream_from(self, start: InitialState) -> Iterator[Array]:
        particles, stepper = self._prepare(start)
        for frame in itertools.count(1):
            stepper.advance_frame(particles, self.substeps, frame)
            yield particles.position

    def _prepare(self, start: InitialState) -> tuple[SphParticles, SphStepper]:
        """The particles of a state, and what advances them."""
        obstacles = start.obstacles_of(PolygonObstacle)
        start.check_particles(self.box, obstacles)
        start.counts_of(1)
        gravity = np.array(self.gravity if start.gravity is None else start.gravity)
        boundary = SolidBoundary(self.box, obstacles, self.spacing)
        particles = SphParticles(start.position, start.velocity, self.fluid.density)
        stepper = SphStepper(self.fluid, boundary, self.spacing, gravity, self.frame_dt / self.substeps)
        stepper.initialise(particles)
        return particles, stepper

    @property
    def type_names(self) -> dict[int, str]:
        return {BOUNDARY: "boundary", WATER: "water"}

    @property
    def max_particles(self) -> int:
        _, layer = box_particles(self.box, self.spacing)
        in_obstacles = 0 if self.obstacles is None else self.obstacles.max_particles(self.spacing)
        return int((layer == 0).sum()) + in_obstacles + self.layout.max_particles(self.spacing)
