"""Presets of weakly compressible smoothed particle hydrodynamics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from nmpm.scene import Interval, Scene
from nmpm.sim.preset import BOUNDARY, Preset, built, checked, require
from nmpm.sim.sph.starts import Column, Start, Strewn, Throw
from nmpm.sim.sph.walls import box_particles
from nmpm.sim.sph.wcsph import REVISION, Fluid
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

WATER = 5
"""Type number of the particles that flow, after DeepMind's scenes."""

CFL_LIMITS = {"sound": 0.4, "viscosity": 0.125, "gravity": 0.25}
"""Longest step, as a part of h / c, of h² / ν and of √(h / g) (Adami, Hu & Adams 2012, equations 19 to 21).

The paper takes 0.25 of h / (c + speed); with density from the velocity just updated, the dam break runs to its end
at 0.42 too.
"""


@dataclass(frozen=True)
class SphPreset(Preset):
    """A family of simulated scenes; `presets/dambreak2d.yaml` and `presets/wbcsph.yaml` comment every entry.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Steps of a frame.
        box: Where the fluid may be, (lower, upper) along x and y, in length.
        domain: What an emulator's grid covers, likewise.
        spacing: Distance between particles at rest, in length.
        gravity: Acceleration, in length per second squared.
        gravity_turn: Largest angle by which a trajectory's gravity is turned either way, in degrees.
        fluid: What flows.
        column: The initial state, if it is a column at rest.
        blocks: The initial state, if it is thrown blocks.
        obstacles: What stands in the fluid's way; nothing if left out.

    Raises:
        ConfigError: if the numbers contradict each other or a step is too long to be stable.
    """

    solver: ClassVar[str] = "wcsph"
    generator: ClassVar[str] = "WCSPH"
    revision: ClassVar[int] = REVISION

    name: str
    frames: int
    frame_dt: float
    substeps: int
    box: tuple[Interval, Interval]
    domain: tuple[Interval, Interval]
    spacing: float
    gravity: tuple[float, float]
    gravity_turn: float
    fluid: Fluid
    column: Column | None = None
    blocks: Throw | None = None
    obstacles: Strewn | None = None

    def __post_init__(self) -> None:
        for key in ("frames", "substeps"):
            require(isinstance(getattr(self, key), int), f"{key} = {getattr(self, key)} must be a whole number.")
        for key in ("frames", "frame_dt", "substeps", "spacing"):
            require(0 < getattr(self, key) < math.inf, f"{key} = {getattr(self, key)} must be positive and finite.")
        require(0 <= self.gravity_turn <= 180, f"gravity_turn = {self.gravity_turn} must be within 0 and 180 degrees.")
        (left, right), (bottom, top) = self.box
        require(left < right and bottom < top, f"box = {self.box} needs (lower, upper) along each axis.")
        require((self.column is None) != (self.blocks is None), "give either column or blocks, as the initial state.")
        if self.column is not None:
            columns, rows = self.column.lattice(self.spacing)
            fits = columns * self.spacing <= right - left + 1e-9 and rows * self.spacing <= top - bottom + 1e-9
            require(fits and columns * rows > 0, f"column = {self.column} does not fit in box = {self.box}.")
        for cause, least in self.least_substeps.items():
            require(
                self.substeps >= least,
                f"substeps = {self.substeps} are too few for {cause}: take at least {least}, or a larger spacing.",
            )

    @property
    def start(self) -> Start:
        """How the initial state is drawn."""
        return next(start for start in (self.column, self.blocks) if start is not None)

    @property
    def least_substeps(self) -> dict[str, int]:
        """Fewest steps of a frame that are stable, by what asks for them: sound, viscosity, gravity."""
        h, strength = self.spacing, math.hypot(*self.gravity)
        longest = {
            "sound": h / self.fluid.speed_of_sound,
            "viscosity": h**2 / max(self.fluid.kinematic_viscosity(h), 1e-300),
            "gravity": math.sqrt(h / max(strength, 1e-300)),
        }
        return {cause: math.ceil(self.frame_dt / (CFL_LIMITS[cause] * dt) - 1e-9) for cause, dt in longest.items()}

    @property
    def particle_volume(self) -> float:
        """Area of one particle at rest."""
        return self.spacing**2

    def simulate(self, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
        from nmpm.sim.sph.simulate import simulate

        return simulate(self, seed, progress)

    @property
    def scene(self) -> Scene:
        return Scene(
            bounds=self.box,
            domain=self.domain,
            dt=self.frame_dt,
            materials=("water",),
            particle_volume=self.particle_volume,
            gravity=None if self.gravity_turn else self.gravity,
            gravity_varies=self.gravity_turn > 0,
            obstacles=True,
        )

    @property
    def type_names(self) -> dict[int, str]:
        return {BOUNDARY: "boundary", WATER: "water"}

    @property
    def most_particles(self) -> int:
        _, layer = box_particles(self.box, self.spacing)
        around = 0 if self.obstacles is None else self.obstacles.most_particles(self.spacing)
        return int((layer == 0).sum()) + around + self.start.most_particles(self.spacing)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> SphPreset:
        entries = checked(cls, plain, "the preset")
        sections = {"fluid": Fluid, "column": Column, "blocks": Throw, "obstacles": Strewn}
        for key in sections.keys() & entries.keys():
            entries[key] = built(sections[key], entries[key], key)
        preset: SphPreset = built(cls, entries, "the preset")
        return preset
