"""Presets of weakly compressible smoothed particle hydrodynamics."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from nmpm.scene import Interval
from nmpm.sim.preset import BOUNDARY, Preset
from nmpm.sim.sph.boundary import ObstacleRanges, PolygonObstacle, SolidBoundary, box_particles
from nmpm.sim.sph.layouts import Column, FluidBlocks, FluidLayout
from nmpm.sim.sph.wcsph import Fluid, SphParticles, SphStepper
from nmpm.sim.state import Array, InitialState, Progress, SimulatedTrajectory, check, record_frames

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
