"""Weakly compressible smoothed particle hydrodynamics in two dimensions.

Water is a slightly compressible fluid: density follows the continuity equation, ρ̇_i = ρ_i Σ V_j (v_i − v_j) · ∇W, and
pressure the density (Tait's equation), with a speed of sound about ten times that of the flow, so that density stays
within about one per cent. The continuity equation is preferred to the sum of masses because a sum would see a lack of
mass at the free surface and pull it in. Walls are dummy particles with pressure and velocity continued from the fluid
(Adami, Hu & Adams, "A generalized wall boundary condition for smoothed particle hydrodynamics", 2012).

Spray, particles with few neighbours, bears no tension, and its pressure fades within the time that sound takes past
ten of them. Otherwise a few particles far from the rest can orbit each other while their densities diverge until they
burst, and a particle torn off under pressure would carry it through the air into the next wave.

A step is kick, drift, kick: half a step of acceleration, a step of position, density from the new positions and the
velocity in between, acceleration anew, and the second half of it. Pairs are listed within a
margin beyond the kernel's reach, and listed anew once a particle has moved by half of it.
"""

from __future__ import annotations

import numpy as np

from nmpm._support.jit import jit
from nmpm.sim.arrays import Array
from nmpm.sim.sph import sums
from nmpm.sim.sph.fluid import Fluid, SphParticles
from nmpm.sim.sph.kernel import SUPPORT
from nmpm.sim.sph.neighbours import CellGrid, PairFinder
from nmpm.sim.sph.walls import SolidBoundary

REVISION = 1
"""Increased whenever the same preset and seed give other numbers."""

# Margin of the list of pairs, in spacings: a larger one lists more pairs, a smaller one lists them more often.
_SKIN = 0.4

# Listed neighbours below which a particle is spray: a third of those within the fluid.
_SPRAY = round(np.pi * (SUPPORT + _SKIN) ** 2 / 3)

# Particles that sound passes while the excess of spray's density falls to 1 / e.
_FADING = 10.0


class SphStepper:
    """Advances particles by steps of one length.

    Args:
        fluid: Its parameters.
        boundary: The walls.
        spacing: Of the particles at rest; also the kernel's smoothing length.
        gravity: (2,) acceleration, in length per second squared.
        dt: Length of a step, in seconds.
    """

    def __init__(self, fluid: Fluid, boundary: SolidBoundary, spacing: float, gravity: Array, dt: float) -> None:
        self.fluid, self.boundary, self.spacing, self.gravity, self.dt = fluid, boundary, spacing, gravity, dt
        self.mass = fluid.density * spacing**2
        self.held_back = 0
        """Particles clamped at surfaces so far."""
        position = boundary.position
        grid = CellGrid.covering(position.min(0), position.max(0), (SUPPORT + _SKIN) * spacing)
        order, self._wall_starts = grid.sort_by_cell(*position.T)
        self._wall_x, self._wall_y = (np.ascontiguousarray(axis) for axis in position[order].T)
        self._grid, self._finder, self._wall_finder = grid, PairFinder(grid), PairFinder(grid)
        self._wall = np.zeros((4, len(position)))
        self._wall_density = np.full(len(position), fluid.density)
        self._memory, self._wall_memory = np.empty((4, 0)), np.empty((4, 0))
        self._listed_at = np.empty((2, 0))
        self._spray = np.empty(0, np.int64)

    def initialise(self, particles: SphParticles) -> None:
        """Initialise accelerations and lists of pairs; call it once before the first step."""
        particles.table[5:7] = 0.0
        self._clamp(particles)
        self._list_pairs(particles)
        self._update_forces(particles, 0.0)

    def step(self, particles: SphParticles) -> None:
        """One step, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        _kick(particles.table, 0.5 * self.dt)
        _drift(particles.table, self.dt)
        self._clamp(particles)
        moved = _max_displacement(particles.table, self._listed_at)
        if not np.isfinite(moved):
            raise FloatingPointError("The state is not finite")
        if moved > 0.5 * _SKIN * self.spacing:
            self._list_pairs(particles)
        self._update_forces(particles, self.dt)
        _kick(particles.table, 0.5 * self.dt)

    def pressure(self, particles: SphParticles) -> Array:
        """(N,) in the first order."""
        return _pressure(particles.density, self.fluid.density, self.fluid.speed_of_sound, self.fluid.exponent)

    def _clamp(self, particles: SphParticles) -> None:
        x, y, vx, vy = particles.table[:4]
        self.held_back += self.boundary.clamp(x, y, vx, vy)

    def _list_pairs(self, particles: SphParticles) -> None:
        order, starts = self._grid.sort_by_cell(particles.table[0], particles.table[1])
        particles.sort(order)
        x, y = particles.table[:2]
        self._listed_at = particles.table[:2].copy()
        self._pairs = self._finder.pairs_within(x, y, starts)
        self._wall_pairs = self._wall_finder.pairs_between(x, y, self._wall_x, self._wall_y, self._wall_starts)
        neighbours = sum(np.bincount(side, minlength=len(x)) for side in (*self._pairs, self._wall_pairs[0]))
        self._spray = np.flatnonzero(neighbours < _SPRAY)
        self._memory = _with_capacity(self._memory, len(self._pairs[0]))
        self._wall_memory = _with_capacity(self._wall_memory, len(self._wall_pairs[0]))

    def _update_forces(self, particles: SphParticles, dt: float) -> None:
        """Density after dt, then accelerations."""
        fluid, h = self.fluid, self.spacing
        rest, sound = fluid.density, fluid.speed_of_sound
        x, y, vx, vy, density, ax, ay = particles.table
        pairs, walls = self._pairs, self._wall_pairs
        dx, dy, f, drag = self._memory[:, : len(pairs[0])]
        wall_dx, wall_dy, wall_f, wall_w = self._wall_memory[:, : len(walls[0])]
        sums.pair_geometry(x, y, *pairs, h, dx, dy, f)
        sums.wall_geometry(x, y, self._wall_x, self._wall_y, *walls, h, wall_dx, wall_dy, wall_f, wall_w)
        rate = np.zeros_like(density)
        sums.expansion(
            *pairs, dx, dy, f, vx, vy, density, self.mass,
            2 * fluid.diffusion * h * sound / rest, rest / sound**2 * self.gravity, 0.01 * h * h, rate, drag,
        )  # fmt: skip
        sums.wall_expansion(*walls, wall_dx, wall_dy, wall_f, vx, vy, self.mass / self._wall_density, rate)
        density *= 1.0 + dt * rate
        kept = np.exp(-dt * sound / (_FADING * h))
        density[self._spray] = rest + kept * np.maximum(density[self._spray] - rest, 0.0)
        pressure = _pressure(density, rest, sound, fluid.exponent)
        sums.wall_averages(*walls, wall_dx, wall_dy, wall_w, vx, vy, density, pressure, self.gravity, self._wall)
        self._wall_density = _density(self._wall[0], rest, sound, fluid.exponent)
        ax[:], ay[:] = self.gravity[0], self.gravity[1]
        viscosity = 8 * fluid.kinematic_viscosity(h)
        sums.push(*pairs, dx, dy, f, drag, density, pressure, self.mass, viscosity, ax, ay)
        sums.wall_push(
            *walls, wall_dx, wall_dy, wall_f, vx, vy, density, pressure,
            self._wall, self._wall_density, self.mass, fluid.viscosity, ax, ay,
        )  # fmt: skip


def _with_capacity(memory: Array, count: int) -> Array:
    return memory if memory.shape[1] >= count else np.empty((memory.shape[0], count + count // 4))


def _pressure(density: Array, rest: float, sound: float, exponent: float) -> Array:
    """Tait's equation of state."""
    return rest * sound**2 / exponent * ((density / rest) ** exponent - 1.0)


def _density(pressure: Array, rest: float, sound: float, exponent: float) -> Array:
    """Inverse of `_pressure`; a tenth of the density at rest where there is none, far below pressures that occur."""
    ratio = 1.0 + pressure * exponent / (rest * sound**2)
    return np.asarray(rest * np.maximum(ratio, 0.1**exponent) ** (1.0 / exponent))


@jit
def _kick(table: Array, dt: float) -> None:
    for i in range(table.shape[1]):
        table[2, i] += dt * table[5, i]
        table[3, i] += dt * table[6, i]


@jit
def _drift(table: Array, dt: float) -> None:
    for i in range(table.shape[1]):
        table[0, i] += dt * table[2, i]
        table[1, i] += dt * table[3, i]


@jit
def _max_displacement(table: Array, listed_at: Array) -> float:
    """Largest displacement of a particle since the pairs were listed; infinite if one is not finite."""
    most = 0.0
    for i in range(table.shape[1]):
        dx, dy = table[0, i] - listed_at[0, i], table[1, i] - listed_at[1, i]
        way = dx * dx + dy * dy
        if not way <= most:
            most = way if way > most else np.inf
    return float(np.sqrt(most))
