"""Presets of the material point method, and how long their substeps may be.

A substep dt on cells of side h has three bounds.

*Waves.* In the bulk, an elastic wave of speed c crosses less than a cell: c dt < h.

*Single particles.* Material alone among its nodes, such as spray, is less stable than the bulk (Sun, Shinar &
Schroeder, "Effective time step restrictions for explicit MPM simulation", 2020; Bai & Schroeder, "Stability analysis of
explicit MPM", 2022). With MLS-MPM's quadratic kernels the nodes return a lone particle's stress to its own velocity
gradient, d(∇·v)/dt = 4 D J p / (ρ h²) in D dimensions, while d(ln J)/dt = ∇·v. That is an oscillator of frequency
ω = (2 / h) √(D S / ρ), S = −d(J p) / d ln J, which the symplectic substep keeps bounded while ω dt < 2:

    dt < h √(ρ / (D S)).

S grows as the material is compressed: water with exponent 7 at 0.65 of its volume has 11 times its stiffness at rest.
The compression is bounded by energy: the fastest particle's kinetic energy, ρ v² / 2, turns into work against the
pressure. This, rather than the wave at rest, is what water's substep is bound by.

*Travel.* Two bodies that meet head-on must not close a cell in one substep, 2 v dt < h; and no particle may pass the
middle of an obstacle, or it would be pushed out on the far side.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np

from nmpm._support.plain_data import from_plain, to_plain
from nmpm.errors import ConfigError
from nmpm.scene import Interval, Scene
from nmpm.sim.mpm.layouts import MpmBlockRanges, RampRanges, SimulatedRamp, distance_to_ramps, fit_ramps
from nmpm.sim.mpm.materials import Goop, Material, Sand, Water
from nmpm.sim.mpm.obstacle_field import ObstacleField, lattice_margin
from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles, MpmStepper, Walls
from nmpm.sim.preset import BOUNDARY, Preset
from nmpm.sim.state import (
    Array,
    InitialState,
    Layout,
    Obstacle,
    Progress,
    SimulatedTrajectory,
    check,
    check_numbers,
    record_frames,
)

CFL_LIMIT = 0.9
"""Cells that an elastic wave may cross in a substep; from 1 on, the explicit substep is unstable."""


def fastest_speed(speed: float, gravity: Sequence[float], sides: Sequence[float], turns: bool) -> float:
    """Speed of a particle that starts with the largest velocity and falls through the whole box.

    Args:
        speed: Largest initial velocity along each axis, in length per second.
        gravity: (D,) acceleration, in length per second squared.
        sides: (D,) lengths of the box's sides.
        turns: Whether gravity may point along the box's diagonal.
    """
    drop = math.hypot(*gravity) * math.hypot(*sides)
    if not turns:
        drop = sum(abs(pull) * side for pull, side in zip(gravity, sides, strict=True))
    return math.sqrt(len(sides) * speed**2 + 2 * drop)


def longest_wave_substep(material: Material, cell_size: float) -> float:
    """Longest substep for elastic waves in material at rest, in seconds."""
    return CFL_LIMIT * cell_size / material.wave_speed


def longest_particle_substep(material: Material, cell_size: float, dim: int, speed: float) -> float:
    """Longest substep for a single particle that is compressed by all of its kinetic energy, in seconds."""
    stiffness = material.bulk_stiffness(material.density * speed**2 / 2)
    return cell_size * math.sqrt(material.density / (dim * stiffness))


def longest_travel_substep(cell_size: float, speed: float, thickness: float) -> float:
    """Longest substep for particles that meet each other or an obstacle of some thickness, in seconds.

    In three dimensions, particles are kept at a larger margin than this allows for.
    """
    return min(cell_size / 2, thickness / 2 + lattice_margin(cell_size, 2)) / max(speed, 1e-300)


MATERIALS: dict[str, type[Material]] = {kind.name: kind for kind in (Water, Sand, Goop)}
"""The constitutive models by name; a new one is added here."""

_ARRANGEMENTS = 20


@dataclass(frozen=True, kw_only=True)
class MpmPreset(Preset):
    """A family of scenes of the material point method; `presets/goop.yaml` comments every entry.

    Box and domain have two or three axes, the second upright. Arguments beside those of `Preset`:

    Args:
        cells: Grid cells along x, from side to side of the box.
        wall_friction: Coulomb friction at the walls.
        materials: What blocks are made of.
        blocks: How the initial state is drawn.
        walls: What the walls do with material that leaves them, a value of `Walls`.
        ramps: Obstacles; with a width in three dimensions.

    Raises:
        ConfigError: if the numbers contradict each other, or a substep is too long for elastic waves at rest.
    """

    solver: ClassVar[str] = "mls_mpm"
    generator: ClassVar[str] = "MLS-MPM"
    revision: ClassVar[int] = 1

    cells: int
    wall_friction: float
    materials: tuple[Material, ...]
    blocks: MpmBlockRanges
    walls: str = Walls.SEPARATE.value
    ramps: RampRanges | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, "", positive=("cells",), at_least_0=("wall_friction",))
        kinds = [kind.value for kind in Walls]
        check(self.walls in kinds, f"walls = {self.walls} is not one of {', '.join(map(repr, kinds))}.")
        check(bool(self.materials), f"materials is empty; known are {', '.join(MATERIALS)}.")
        self._check_axes()
        least, fastest = self._wave_substeps, max(material.wave_speed for material in self.materials)
        check(
            self.substeps >= least,
            f"substeps = {self.substeps} are too few: at {fastest:.1f} m/s an elastic wave crosses more than "
            f"{CFL_LIMIT} cells in one. Take at least {least}, or a softer material.",
        )

    def _check_axes(self) -> None:
        check(self.dim in (2, 3), f"box = {self.box} has {self.dim} axes; 2 or 3 are possible.")
        for key in ("domain", "gravity"):
            check(len(getattr(self, key)) == self.dim, f"{key} = {getattr(self, key)} needs {self.dim} entries.")
        for low, high in self.box:
            check(self.spacing < high - low, f"spacing = {self.spacing} must be less than the box's sides.")
            cells = (high - low) / self.cell_size
            check(
                abs(cells - round(cells)) < 1e-6,
                f"cells = {self.cells} along x make {cells:.3f} from {low} to {high}, not a whole number.",
            )
        needs_2d = self.gravity_turn or self.walls == Walls.OPEN_CORNERS.value
        check(
            self.dim == 2 or not needs_2d,
            "gravity_turn and open corners are implemented in two dimensions, not in three.",
        )
        if self.ramps is not None and (self.ramps.width is None) != (self.dim == 2):
            raise ConfigError(f"ramps.width = {self.ramps.width}: ramps have a width in three dimensions, not in two.")
        for material in self.materials:
            material.rest(self.dim)

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.box)

    @property
    def cell_size(self) -> float:
        """Side of a grid cell, in length."""
        return (self.box[0][1] - self.box[0][0]) / self.cells

    @property
    def wall_layer(self) -> float:
        """Cells beyond the box that particles get into: one and a half where walls hold what touches them."""
        return 0.0 if Walls(self.walls) is Walls.SEPARATE else 1.5

    @property
    def reach(self) -> tuple[Interval, ...]:
        """The box and its wall layer."""
        layer = self.wall_layer * self.cell_size
        ends = ((low - layer, high + layer) for low, high in self.box)
        return tuple(_snap(pair, edges) for pair, edges in zip(ends, self.domain, strict=True))

    @property
    def _wave_substeps(self) -> int:
        """Fewest substeps of a frame that keep elastic waves at rest within `CFL_LIMIT`: necessary, not sufficient."""
        longest = min(longest_wave_substep(material, self.cell_size) for material in self.materials)
        return math.ceil(self.frame_dt / longest - 1e-9)

    @property
    def stable_substeps(self) -> int:
        """Fewest substeps of a frame that are stable by every bound above.

        The speeds that go into them are the largest that the preset's initial velocities and falls can add up to.
        """
        size, dim = self.cell_size, self.dim
        speed = fastest_speed(
            self.blocks.speed, self.gravity, [high - low for low, high in self.box], self.gravity_turn > 0
        )
        thickness = math.inf if self.ramps is None else self.ramps.thickness
        bounds = [longest_travel_substep(size, speed, thickness)]
        bounds += [longest_particle_substep(material, size, dim, speed) for material in self.materials]
        return max(self._wave_substeps, math.ceil(self.frame_dt / min(bounds) - 1e-9))

    @property
    def _layouts(self) -> dict[str, Layout]:
        return {"blocks": self.blocks}

    def coarsened(self, factor: int) -> MpmPreset:
        """The same particles on a grid with cells `factor` times as large, with `stable_substeps` substeps.

        Raises:
            ConfigError: if the cells do not divide by the factor.
        """
        check(self.cells % factor == 0, f"{self.cells} cells cannot be coarsened {factor} times.")
        return self._with_stable_substeps(1, cells=self.cells // factor)

    def widened(self, times: int) -> MpmPreset:
        """Scenes in a domain so many times as wide, with up to as many times as many particles and blocks."""
        box, domain, cells = self._widened_sides(times, self.cell_size)
        return dataclasses.replace(self, box=box, domain=domain, cells=cells, blocks=self.blocks.multiplied(times))

    def draw(self, seed: int) -> InitialState:
        rng = np.random.default_rng(seed)
        gravity = self._draw_gravity(rng)
        for _ in range(_ARRANGEMENTS):
            start, extents = self.blocks.draw(self.box, self.spacing, len(self.materials), rng)
            try:
                ramps = () if self.ramps is None else self.ramps.draw(self.box, extents, rng)
            except ConfigError as error:  # These blocks leave no room; others may.
                reason = error
                continue
            return dataclasses.replace(start, gravity=gravity, obstacles=ramps)
        raise reason

    def simulate_from(self, start: InitialState, frames: int, progress: Progress | None = None) -> SimulatedTrajectory:
        particles, stepper = self._prepare(start)
        counts, ramps = start.counts_of(len(self.materials)), start.obstacles_of(SimulatedRamp)

        def advance(frame: int) -> Array:
            stepper.advance_frame(particles, self.substeps, frame)
            return particles.position

        static = np.concatenate([np.empty((0, self.dim)), *(ramp.particles(self.spacing) for ramp in ramps)])
        position = record_frames(particles.position, static, frames, advance, progress)
        types = [*(material.particle_type for material in self.materials), BOUNDARY]
        particle_type = np.repeat(types, [*counts, len(static)]).astype(np.int64)
        attributes: dict[str, Any] = {"held_back": stepper.held_back}
        if ramps:
            attributes["pushed_out"] = stepper.pushed_out
        if self.gravity_turn:
            attributes["gravity"] = stepper.grid.gravity
        return SimulatedTrajectory(position, particle_type, attributes)

    def stream_from(self, start: InitialState) -> Iterator[Array]:
        particles, stepper = self._prepare(start)
        for frame in itertools.count(1):
            stepper.advance_frame(particles, self.substeps, frame)
            yield particles.position

    def _prepare(self, start: InitialState) -> tuple[MpmParticles, MpmStepper]:
        """The particles of a state, and what advances them."""
        start.check_particles(self.reach)
        counts, ramps = start.counts_of(len(self.materials)), start.obstacles_of(SimulatedRamp)
        gravity = self.gravity if start.gravity is None else start.gravity
        groups = tuple(zip(self.materials, counts, strict=True))
        particles = MpmParticles(start.position, start.velocity, groups, self.spacing**self.dim)
        stepper = MpmStepper(self._grid(gravity, ramps), self.frame_dt / self.substeps)
        stepper.enclose(particles)
        return particles, stepper

    def obstacles_from(self, particles: Array) -> tuple[Obstacle, ...]:
        if self.ramps is None or self.dim != 2:
            return super().obstacles_from(particles)
        return fit_ramps(particles, self.ramps.thickness, self.spacing) if len(particles) else ()

    def _grid(self, gravity: tuple[float, ...], ramps: tuple[SimulatedRamp, ...]) -> MpmGrid:
        low, high = np.array(self.reach).T
        shape = tuple(round(cells) for cells in (high - low) / self.cell_size)
        pull = np.array(gravity, dtype=np.float64)
        grid = MpmGrid(low, self.cell_size, shape, self.wall_friction, pull, Walls(self.walls))
        if not ramps:
            return grid
        distance = partial(distance_to_ramps, ramps)
        obstacles = ObstacleField.sample(distance, low, self.cell_size, shape, self.wall_friction)
        return dataclasses.replace(grid, obstacles=obstacles)

    @property
    def scene(self) -> Scene:
        densities = tuple(material.density for material in self.materials) if len(self.materials) > 1 else ()
        return dataclasses.replace(super().scene, densities=densities)

    @property
    def type_names(self) -> dict[int, str]:
        names = {material.particle_type: material.name for material in self.materials}
        return names if self.ramps is None else names | {BOUNDARY: "boundary"}

    @property
    def max_particles(self) -> int:
        static = 0 if self.ramps is None else self.ramps.max_particles(self.spacing)
        return self.blocks.particles[1] + static

    def to_dict(self) -> dict[str, Any]:
        plain = super().to_dict() | {"materials": {material.name: to_plain(material) for material in self.materials}}
        if self.ramps is not None and self.ramps.width is None:
            del plain["ramps"]["width"]
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        if "materials" not in plain:
            return super().from_dict(plain)
        section = plain["materials"]
        check(isinstance(section, Mapping), "materials must map names to parameters.")
        unknown = sorted(set(section) - set(MATERIALS))
        check(not unknown, f"Unknown material {', '.join(map(str, unknown))}; known are {', '.join(MATERIALS)}.")
        read = {name: from_plain(MATERIALS[name], entries, f"materials.{name}") for name, entries in section.items()}
        return super().from_dict({**plain, "materials": tuple(read.values())})


def _snap(ends: Interval, edges: Interval) -> Interval:
    """The ends, those that are an edge of the domain but for rounding exactly so: a gap would be a wall layer."""
    low, high = (edge if math.isclose(end, edge, abs_tol=1e-9) else end for end, edge in zip(ends, edges, strict=True))
    return low, high
