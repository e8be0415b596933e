"""Presets of the material point method."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from nmpm.errors import ConfigError
from nmpm.scene import Interval, Scene
from nmpm.sim.materials import MATERIALS, Material
from nmpm.sim.mls_mpm import REVISION, Walls
from nmpm.sim.preset import Preset, built, checked, require
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

CFL_LIMIT = 0.9
"""Cells that an elastic wave may cross in a substep; from 1 on, the explicit substep is unstable."""


@dataclass(frozen=True)
class Blocks:
    """How the initial state is drawn; lengths in metres.

    Args:
        number: Least and most blocks in a scene.
        particles: Least and most particles in a scene.
        share: Least part of the particles in one block.
        aspect: Least and largest height over width.
        gap: Least distance between blocks, and from the box's sides.
        speed: Largest initial velocity along each axis, in length per second.
        jitter: Largest displacement of a particle off the lattice along each axis, in spacings.

    Raises:
        ConfigError: if a range is empty or out of reach.
    """

    number: tuple[int, int]
    particles: tuple[int, int]
    share: float
    aspect: tuple[float, float]
    gap: float
    speed: float
    jitter: float

    def __post_init__(self) -> None:
        for key in ("number", "particles", "aspect"):
            low, high = getattr(self, key)
            require(0 < low <= high, f"blocks.{key} = {[low, high]} needs two positive numbers, the lower first.")
        require(0 < self.share * self.number[1] <= 1, f"blocks.share = {self.share} is too large for the blocks.")
        require(0 <= self.jitter < 0.5, f"blocks.jitter = {self.jitter} must be at least 0 and below 0.5.")
        require(self.gap >= 0 and self.speed >= 0, "blocks.gap and blocks.speed must not be negative.")


@dataclass(frozen=True)
class MpmPreset(Preset):
    """A family of simulated scenes; `presets/goop.yaml` comments every entry.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Substeps of a frame.
        box: Where particles may be, (lower, upper) along x and y, in length; walls that hold let them into a layer
            around it, see `reach`.
        domain: What an emulator's grid covers, likewise.
        cells: Grid cells along x, from side to side of the box.
        spacing: Distance between particles in the initial lattice, in length.
        gravity: Acceleration, in length per second squared.
        wall_friction: Coulomb friction at the walls.
        materials: What blocks are made of.
        blocks: How the initial state is drawn.
        walls: What the walls do with material that leaves them, a value of `Walls`.

    Raises:
        ConfigError: if the numbers contradict each other or a substep is too long to be stable.
    """

    solver: ClassVar[str] = "mls_mpm"
    generator: ClassVar[str] = "MLS-MPM"
    revision: ClassVar[int] = REVISION

    name: str
    frames: int
    frame_dt: float
    substeps: int
    box: tuple[Interval, Interval]
    domain: tuple[Interval, Interval]
    cells: int
    spacing: float
    gravity: tuple[float, float]
    wall_friction: float
    materials: tuple[Material, ...]
    blocks: Blocks
    walls: str = Walls.SEPARATE.value

    def __post_init__(self) -> None:
        for key in ("frames", "substeps", "cells"):
            require(isinstance(getattr(self, key), int), f"{key} = {getattr(self, key)} must be a whole number.")
        for key in ("frames", "frame_dt", "substeps", "cells", "spacing"):
            require(0 < getattr(self, key) < math.inf, f"{key} = {getattr(self, key)} must be positive and finite.")
        require(self.wall_friction >= 0, f"wall_friction = {self.wall_friction} must not be negative.")
        known = [kind.value for kind in Walls]
        require(self.walls in known, f"walls = {self.walls} is not one of {', '.join(map(repr, known))}.")
        require(bool(self.materials), f"materials is empty; known are {', '.join(MATERIALS)}.")
        (left, right), (bottom, top) = self.box
        require(left < right and bottom < top, f"box = {self.box} needs (lower, upper) along each axis.")
        rows = (top - bottom) / self.cell_size
        require(
            abs(rows - round(rows)) < 1e-6, f"cells = {self.cells} along x make {rows:.3f} rows, not a whole number."
        )
        least = self.least_substeps
        require(
            self.substeps >= least,
            f"substeps = {self.substeps} are too few: at {self.wave_speed:.1f} m/s an elastic wave crosses more than "
            f"{CFL_LIMIT} cells in one. Take at least {least}, or a softer material.",
        )

    @property
    def cell_size(self) -> float:
        """Side of a grid cell, in length."""
        return (self.box[0][1] - self.box[0][0]) / self.cells

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Grid cells along x and y."""
        return self.cells, round((self.box[1][1] - self.box[1][0]) / self.cell_size)

    @property
    def reach(self) -> tuple[Interval, Interval]:
        """How far particles can get: the box, and a cell and a half beyond it where walls hold what touches them."""
        (left, right), (bottom, top) = self.box
        layer = 0.0 if Walls(self.walls) is Walls.SEPARATE else 1.5 * self.cell_size
        return (left - layer, right + layer), (bottom - layer, top + layer)

    @property
    def particle_volume(self) -> float:
        """Area of one particle."""
        return self.spacing**2

    @property
    def wave_speed(self) -> float:
        """Of the fastest elastic wave, in length per second."""
        return max(material.wave_speed for material in self.materials)

    @property
    def least_substeps(self) -> int:
        """Fewest substeps of a frame that keep elastic waves within `CFL_LIMIT`."""
        return math.ceil(self.frame_dt * self.wave_speed / (CFL_LIMIT * self.cell_size))

    def coarsened(self, factor: int) -> MpmPreset:
        """The same particles on a grid with cells `factor` times as large and substeps as long as stability allows.

        Raises:
            ConfigError: if the cells do not divide by the factor.
        """
        require(self.cells % factor == 0, f"{self.cells} cells cannot be coarsened {factor} times.")
        longest = dataclasses.replace(self, cells=self.cells // factor, substeps=2**31)
        return dataclasses.replace(longest, substeps=longest.least_substeps)

    def simulate(self, seed: int, progress: Progress | None = None) -> SimulatedTrajectory:
        from nmpm.sim.mpm import simulate

        return simulate(self, seed, progress)

    @property
    def scene(self) -> Scene:
        return Scene(
            bounds=self.reach,
            domain=self.domain,
            dt=self.frame_dt,
            materials=tuple(material.name for material in self.materials),
            particle_volume=self.particle_volume,
            gravity=self.gravity,
        )

    @property
    def type_names(self) -> dict[int, str]:
        return {material.particle_type: material.name for material in self.materials}

    @property
    def most_particles(self) -> int:
        return self.blocks.particles[1]

    def to_dict(self) -> dict[str, Any]:
        return super().to_dict() | {"materials": {material.name: material.to_dict() for material in self.materials}}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> MpmPreset:
        entries = checked(cls, plain, "the preset")
        entries["blocks"] = built(Blocks, entries["blocks"], "blocks")
        entries["materials"] = _materials(entries["materials"])
        preset: MpmPreset = built(cls, entries, "the preset")
        return preset


def _materials(plain: Any) -> tuple[Material, ...]:
    if not isinstance(plain, Mapping):
        raise ConfigError("materials must map names to parameters.")
    unknown = sorted(set(plain) - set(MATERIALS))
    if unknown:
        raise ConfigError(f"Unknown material {', '.join(map(str, unknown))}; known are {', '.join(MATERIALS)}.")
    return tuple(built(MATERIALS[name], parameters, f"materials.{name}") for name, parameters in plain.items())
