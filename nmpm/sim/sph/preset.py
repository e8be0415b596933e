"""Presets of weakly compressible smoothed particle hydrodynamics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from nmpm._support.plain_data import from_plain
from nmpm.errors import DataError
from nmpm.scene import Interval, Scene
from nmpm.sim.blocks import draw_gravity
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


@dataclass(frozen=True)
class SphPreset(Preset):
    """A family of scenes of WCSPH; `presets/dambreak2d.yaml` and `presets/wbcsph.yaml` comment every entry.

    Arguments beside those of `Preset`:

    Args:
        spacing: Distance between particles at rest, in length.
        gravity: Acceleration, in length per second squared.
        gravity_turn: Largest angle by which a trajectory's gravity is turned either way, in degrees.
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
    spacing: float
    gravity: tuple[float, float]
    gravity_turn: float
    fluid: Fluid
    column: Column | None = None
    blocks: FluidBlocks | None = None
    obstacles: ObstacleRanges | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive("spacing")
        check(0 <= self.gravity_turn <= 180, f"gravity_turn = {self.gravity_turn} must be within 0 and 180 degrees.")
        (left, right), (bottom, top) = self.box
        check(left < right and bottom < top, f"box = {self.box} needs (lower, upper) along each axis.")
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
        return next(layout for layout in (self.column, self.blocks) if layout is not None)

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

    def varied(self, *, speed: float = 1.0, gravity: float = 1.0) -> SphPreset:
        """As `Preset.varied`; a column starts at rest whatever the factor.

        The speed of sound stays, so that flows which come near it fail as unstable.
        """
        x, y = self.gravity
        many = dataclasses.replace(self._with_layout(self.layout.faster(speed)), substeps=2**31)
        many = dataclasses.replace(many, gravity=(gravity * x, gravity * y))
        return dataclasses.replace(many, substeps=max(self.substeps, many.stable_substeps))

    def widened(self, times: int) -> SphPreset:
        """Scenes in a domain so many times as wide; a column becomes as many times as wide, too."""
        box, domain, _ = self._widened_sides(times, self.spacing)
        wide = dataclasses.replace(self, box=(box, self.box[1]), domain=(domain, self.domain[1]))
        return wide._with_layout(self.layout.multiplied(times))

    def coarsened(self, factor: int) -> SphPreset:
        """The same scenes in particles `factor` times as wide apart, with `stable_substeps` substeps.

        The particles are other ones, `factor`² times fewer: trajectories can be compared as fields, not one by one.
        Artificial viscosity grows with the spacing.

        Raises:
            ConfigError: if the scene has no room for particles of that size.
        """
        many = dataclasses.replace(self, substeps=2**31, spacing=factor * self.spacing)
        many = many._with_layout(self.layout.coarsened(factor))
        return dataclasses.replace(many, substeps=many.stable_substeps)

    def _with_layout(self, layout: FluidLayout) -> SphPreset:
        changed: dict[str, Any] = {"blocks" if self.column is None else "column": layout}
        return dataclasses.replace(self, **changed)

    def draw(self, seed: int) -> InitialState:
        rng = np.random.default_rng(seed)
        gravity = draw_gravity(self.gravity, self.gravity_turn, rng)
        obstacles = () if self.obstacles is None else self.obstacles.draw(self.box, rng)
        position, velocity = self.layout.draw(self.box, self.spacing, obstacles, rng)
        return InitialState(position, velocity, gravity, (len(position),), obstacles)

    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        """As `Preset.simulate_from`; densities start at rest, and accelerations follow from the state."""
        obstacles = _polygons_of(start)
        start.check_particles(self.box, obstacles)
        if start.counts not in ((), (len(start.position),)):
            raise DataError(f"Counts {start.counts} are not those of {len(start.position)} particles of one fluid.")
        gravity = np.array(self.gravity if start.gravity is None else start.gravity)
        boundary = SolidBoundary(self.box, obstacles, self.spacing)
        particles = SphParticles(start.position, start.velocity, self.fluid.density)
        stepper = SphStepper(self.fluid, boundary, self.spacing, gravity, self.frame_dt / self.substeps)
        stepper.initialise(particles)
        deviations = [0.0]

        def advance(frame: int) -> Array:
            deviations.append(stepper.advance_frame(particles, self.substeps, frame))
            return particles.position

        walls = boundary.position[boundary.visible]
        position = record_frames(particles.position, walls, frames, advance, progress)
        particle_type = np.repeat([WATER, BOUNDARY], [len(start.position), len(walls)]).astype(np.int64)
        attributes = {"gravity": gravity, "held_back": stepper.held_back, "density_deviation": max(deviations)}
        return SimulatedTrajectory(position, particle_type, attributes)

    @property
    def scene(self) -> Scene:
        return Scene(
            bounds=self.box,
            domain=self.domain,
            dt=self.frame_dt,
            materials=("water",),
            particle_volume=self.spacing**2,
            gravity=None if self.gravity_turn else self.gravity,
            gravity_varies=self.gravity_turn > 0,
            obstacles=True,
        )

    @property
    def type_names(self) -> dict[int, str]:
        return {BOUNDARY: "boundary", WATER: "water"}

    @property
    def max_particles(self) -> int:
        _, layer = box_particles(self.box, self.spacing)
        in_obstacles = 0 if self.obstacles is None else self.obstacles.max_particles(self.spacing)
        return int((layer == 0).sum()) + in_obstacles + self.layout.max_particles(self.spacing)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> SphPreset:
        return from_plain(cls, plain, "the preset")


def _polygons_of(start: InitialState) -> tuple[PolygonObstacle, ...]:
    polygons = tuple(obstacle for obstacle in start.obstacles if isinstance(obstacle, PolygonObstacle))
    if len(polygons) != len(start.obstacles):
        raise DataError("WCSPH simulates polygons as obstacles; others are not implemented.")
    return polygons
