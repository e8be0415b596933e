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
from nmpm.sim.obstacles import Ramps
from nmpm.sim.preset import BOUNDARY, Preset, built, checked, require
from nmpm.sim.solid import THINNEST
from nmpm.sim.thrown import Thrown
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

CFL_LIMIT = 0.9
"""Cells that an elastic wave may cross in a substep; from 1 on, the explicit substep is unstable."""


@dataclass(frozen=True)
class Blocks(Thrown):
    """How the initial state is drawn: `Thrown`, and where to.

    Args:
        height: Least and largest height of a block above the box's bottom, where the gap leaves it; anywhere when
            left out.

    Raises:
        ConfigError: if a range is empty or out of reach.
    """

    height: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.height or (0.0, 0.0)
        require(0 <= low <= high, f"blocks.height = {self.height} needs two numbers, the lower first.")


@dataclass(frozen=True)
class MpmPreset(Preset):
    """A family of simulated scenes; `presets/goop.yaml` comments every entry.

    Args:
        name: Of the family.
        frames: Simulated frames of a trajectory after its initial state.
        frame_dt: Time between frames, in seconds.
        substeps: Substeps of a frame.
        box: Where particles may be, (lower, upper) along two or three axes, the second upright, in length; walls that
            hold let them into a layer around it, see `reach`.
        domain: What an emulator's grid covers, likewise.
        cells: Grid cells along x, from side to side of the box.
        spacing: Distance between particles in the initial lattice, in length.
        gravity: Acceleration, in length per second squared.
        wall_friction: Coulomb friction at the walls.
        materials: What blocks are made of.
        blocks: How the initial state is drawn.
        walls: What the walls do with material that leaves them, a value of `Walls`.
        gravity_turn: Angle by which gravity is turned in a trajectory, at most, in degrees; in two dimensions only.
        ramps: Obstacles; in two dimensions only.

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
    box: tuple[Interval, ...]
    domain: tuple[Interval, ...]
    cells: int
    spacing: float
    gravity: tuple[float, ...]
    wall_friction: float
    materials: tuple[Material, ...]
    blocks: Blocks
    walls: str = Walls.SEPARATE.value
    gravity_turn: float = 0.0
    ramps: Ramps | None = None

    def __post_init__(self) -> None:
        for key in ("frames", "substeps", "cells"):
            require(isinstance(getattr(self, key), int), f"{key} = {getattr(self, key)} must be a whole number.")
        for key in ("frames", "frame_dt", "substeps", "cells", "spacing"):
            require(0 < getattr(self, key) < math.inf, f"{key} = {getattr(self, key)} must be positive and finite.")
        require(self.wall_friction >= 0, f"wall_friction = {self.wall_friction} must not be negative.")
        known = [kind.value for kind in Walls]
        require(self.walls in known, f"walls = {self.walls} is not one of {', '.join(map(repr, known))}.")
        require(bool(self.materials), f"materials is empty; known are {', '.join(MATERIALS)}.")
        self._check_axes()
        least = self.least_substeps
        require(
            self.substeps >= least,
            f"substeps = {self.substeps} are too few: at {self.wave_speed:.1f} m/s an elastic wave crosses more than "
            f"{CFL_LIMIT} cells in one. Take at least {least}, or a softer material.",
        )

    def _check_axes(self) -> None:
        require(self.dim in (2, 3), f"box = {self.box} has {self.dim} axes; 2 or 3 are possible.")
        require(all(low < high for low, high in self.box), f"box = {self.box} needs (lower, upper) along each axis.")
        for key in ("domain", "gravity"):
            require(len(getattr(self, key)) == self.dim, f"{key} = {getattr(self, key)} needs {self.dim} entries.")
        for low, high in self.box:
            cells = (high - low) / self.cell_size
            require(
                abs(cells - round(cells)) < 1e-6,
                f"cells = {self.cells} along x make {cells:.3f} from {low} to {high}, not a whole number.",
            )
        require(0 <= self.gravity_turn <= 180, f"gravity_turn = {self.gravity_turn} must be within 0 and 180 degrees.")
        flat = self.dim == 2 or (
            self.ramps is None and not self.gravity_turn and self.walls != Walls.OPEN_CORNERS.value
        )
        require(flat, "ramps, gravity_turn and open corners are known in two dimensions, not in three.")
        for material in self.materials:
            material.rest(self.dim)
        thinnest = THINNEST * self.cell_size
        require(
            self.ramps is None or self.ramps.thickness >= thinnest,
            f"ramps.thickness must be at least {THINNEST:g} cells, {thinnest:.4g}.",
        )

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.box)

    @property
    def cell_size(self) -> float:
        """Side of a grid cell, in length."""
        return (self.box[0][1] - self.box[0][0]) / self.cells

    @property
    def grid_shape(self) -> tuple[int, ...]:
        """Grid cells along each axis."""
        return tuple(round((high - low) / self.cell_size) for low, high in self.box)

    @property
    def reach(self) -> tuple[Interval, ...]:
        """How far particles can get: the box, and a cell and a half beyond it where walls hold what touches them."""
        layer = 0.0 if Walls(self.walls) is Walls.SEPARATE else 1.5 * self.cell_size
        return tuple((low - layer, high + layer) for low, high in self.box)

    @property
    def particle_volume(self) -> float:
        """Area of one particle, or volume in three dimensions."""
        return self.spacing**self.dim

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

    def widened(self, times: int) -> MpmPreset:
        """Scenes in a box whose domain is so many times as wide, with up to as many times as many particles and blocks.

        The box is as wide as whole cells of the simulator allow, its wall layer on the right at least what it was.
        """
        (left, right), *others = self.domain
        low, high = self.box[0]
        edge = left + times * (right - left)
        cells = math.floor((edge - (right - high) - low) / self.cell_size + 1e-9)
        blocks = dataclasses.replace(
            self.blocks,
            particles=(self.blocks.particles[0], times * self.blocks.particles[1]),
            number=(self.blocks.number[0], times * self.blocks.number[1]),
            share=self.blocks.share / times,
        )
        return dataclasses.replace(
            self,
            box=((low, low + cells * self.cell_size), *self.box[1:]),
            domain=((left, edge), *others),
            cells=cells,
            blocks=blocks,
        )

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
            gravity=None if self.gravity_turn else self.gravity,
            gravity_varies=self.gravity_turn > 0,
            obstacles=self.ramps is not None,
        )

    @property
    def type_names(self) -> dict[int, str]:
        names = {material.particle_type: material.name for material in self.materials}
        return names if self.ramps is None else names | {BOUNDARY: "boundary"}

    @property
    def most_particles(self) -> int:
        around = 0 if self.ramps is None else self.ramps.most_particles(self.spacing)
        return self.blocks.particles[1] + around

    def to_dict(self) -> dict[str, Any]:
        return super().to_dict() | {"materials": {material.name: material.to_dict() for material in self.materials}}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> MpmPreset:
        entries = checked(cls, plain, "the preset")
        entries["blocks"] = built(Blocks, entries["blocks"], "blocks")
        entries["materials"] = _materials(entries["materials"])
        if entries.get("ramps") is not None:
            entries["ramps"] = built(Ramps, entries["ramps"], "ramps")
        preset: MpmPreset = built(cls, entries, "the preset")
        return preset


def _materials(plain: Any) -> tuple[Material, ...]:
    if not isinstance(plain, Mapping):
        raise ConfigError("materials must map names to parameters.")
    unknown = sorted(set(plain) - set(MATERIALS))
    if unknown:
        raise ConfigError(f"Unknown material {', '.join(map(str, unknown))}; known are {', '.join(MATERIALS)}.")
    return tuple(built(MATERIALS[name], parameters, f"materials.{name}") for name, parameters in plain.items())
