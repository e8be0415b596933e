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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.errors import UnstableError
from nmpm.sim.sph import sums
from nmpm.sim.sph.boundary import SolidBoundary
from nmpm.sim.sph.neighbours import PairLists
from nmpm.sim.sph.sums import SUPPORT
from nmpm.sim.state import Array, check_numbers

# Margin of the list of pairs, in spacings: a larger one lists more pairs, a smaller one lists them more often.
_SKIN = 0.4

# Listed neighbours below which a particle is spray: a third of those within the fluid.
_SPRAY = round(np.pi * (SUPPORT + _SKIN) ** 2 / 3)

# Particles that sound passes while the excess of spray's density falls to 1 / e.
_FADING = 10.0

DENSITY_LIMIT = 0.5
"""Largest deviation of a particle's density from that at rest, as a part of it; beyond, the run is unstable."""


@dataclass(frozen=True)
class Fluid:
    """Parameters of a weakly compressible fluid.

    Args:
        density: At rest, in kg / m².
        speed_of_sound: In m / s; ten times the fastest flow keeps density within one per cent.
        exponent: Of Tait's equation, p = ρ₀ c² / γ ((ρ / ρ₀)^γ − 1).
        alpha: Artificial viscosity; it amounts to a kinematic viscosity of α h c / 8.
        viscosity: Dynamic, in Pa s, which also brakes the fluid at walls; 0 lets it slip.
        diffusion: Of density, δ, which smooths what is uneven from particle to particle; 0.1 is usual.
    """

    density: float
    speed_of_sound: float
    exponent: float
    alpha: float
    viscosity: float
    diffusion: float

    def __post_init__(self) -> None:
        positive, at_least_0 = ("density", "speed_of_sound", "exponent"), ("alpha", "viscosity", "diffusion")
        check_numbers(self, "fluid.", positive=positive, at_least_0=at_least_0)

    def kinematic_viscosity(self, spacing: float) -> float:
        """Artificial and physical viscosity together, in m² / s."""
        return self.alpha * spacing * self.speed_of_sound / 8 + self.viscosity / self.density


class SphParticles:
    """N moving particles; they are sorted by cell now and then, and given back in the first order.

    Args:
        position: (N, 2) in length.
        velocity: (N, 2) in length per second.
        density: Of all particles, at the start.
    """

    def __init__(self, position: NDArray[np.floating], velocity: NDArray[np.floating], density: float) -> None:
        self.table: Array = np.zeros((7, len(position)))
        self.table[0:2], self.table[2:4], self.table[4] = position.T, velocity.T, density
        self.identity: NDArray[np.int64] = np.arange(len(position))
        """(N,) index that each particle had at the start."""

    def sort(self, order: NDArray[np.int64]) -> None:
        """Reorder the particles."""
        self.table[:] = self.table[:, order]
        self.identity = self.identity[order]

    @property
    def position(self) -> Array:
        """(N, 2) in the first order."""
        return self._in_first_order(slice(0, 2))

    @property
    def velocity(self) -> Array:
        """(N, 2) in the first order."""
        return self._in_first_order(slice(2, 4))

    @property
    def density(self) -> Array:
        """(N,) in the first order."""
        return self._in_first_order(slice(4, 5))[:, 0]

    def _in_first_order(self, rows: slice) -> Array:
        ordered = np.empty((self.table.shape[1], rows.stop - rows.start))
        ordered[self.identity] = self.table[rows].T
        return ordered


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
        self._lists = PairLists(boundary.position, (SUPPORT + _SKIN) * spacing)
        self._wall = np.zeros((4, len(boundary.position)))
        self._wall_density = np.full(len(boundary.position), fluid.density)
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

    def advance_frame(self, particles: SphParticles, substeps: int, frame: int) -> float:
        """The steps of a frame, in place; returns the largest deviation of density at its end.

        Raises:
            UnstableError: if the simulation becomes unstable; the message names the frame.
        """
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # overflow is found below
                for _ in range(substeps):
                    self.step(particles)
        except FloatingPointError as error:
            raise UnstableError(f"{error} in frame {frame}; take more substeps or a higher speed of sound.") from error
        rest, sound = self.fluid.density, self.fluid.speed_of_sound
        deviation = float(np.abs(particles.density / rest - 1).max())
        fastest = float(np.hypot(*particles.velocity.T).max())
        if not (deviation <= DENSITY_LIMIT and fastest <= sound):
            raise UnstableError(
                f"The simulation has blown up in frame {frame}: density deviates by {deviation:.0%} (limit"
                f" {DENSITY_LIMIT:.0%}), the fastest particle moves at {fastest:.3g} m/s (sound: {sound:.3g}). Take"
                " more substeps, a higher speed of sound or more viscosity, or leave this seed out."
            )
        outside = self.boundary.count_outside(particles.position)
        if outside:
            raise UnstableError(f"{outside} particles are outside of the box or in an obstacle in frame {frame}.")
        return deviation

    def pressure(self, particles: SphParticles) -> Array:
        """(N,) in the first order."""
        return _pressure(particles.density, self.fluid.density, self.fluid.speed_of_sound, self.fluid.exponent)

    def _clamp(self, particles: SphParticles) -> None:
        x, y, vx, vy = particles.table[:4]
        self.held_back += self.boundary.clamp(x, y, vx, vy)

    def _list_pairs(self, particles: SphParticles) -> None:
        x, y = particles.table[:2]
        order, starts = self._lists.sort_by_cell(x, y)
        particles.sort(order)
        self._listed_at = particles.table[:2].copy()
        self._pairs, self._wall_pairs = self._lists.near(x, y, starts)
        sides = (self._pairs.first, self._pairs.second, self._wall_pairs.first)
        neighbours = sum(np.bincount(side, minlength=len(order)) for side in sides)
        self._spray = np.flatnonzero(neighbours < _SPRAY)

    def _update_forces(self, particles: SphParticles, dt: float) -> None:
        """Density after dt, then accelerations."""
        fluid, h = self.fluid, self.spacing
        rest, sound = fluid.density, fluid.speed_of_sound
        table, pairs, walls = particles.table, self._pairs, self._wall_pairs
        density = table[4]
        sums.pair_geometry(table, pairs, h)
        sums.wall_geometry(table, self._lists.wall_x, self._lists.wall_y, walls, h)
        rate, diffusion = np.zeros_like(density), 2 * fluid.diffusion * h * sound / rest
        sums.expansion(pairs, table, self.mass, diffusion, rest / sound**2 * self.gravity, 0.01 * h * h, rate)
        sums.wall_expansion(walls, table, self.mass / self._wall_density, rate)
        density *= 1.0 + dt * rate
        kept = np.exp(-dt * sound / (_FADING * h))
        density[self._spray] = rest + kept * np.maximum(density[self._spray] - rest, 0.0)
        pressure = _pressure(density, rest, sound, fluid.exponent)
        sums.wall_averages(walls, table, pressure, self.gravity, self._wall)
        self._wall_density = _density(self._wall[0], rest, sound, fluid.exponent)
        table[5:7] = self.gravity[:, None]
        sums.push(pairs, table, pressure, self.mass, 8 * fluid.kinematic_viscosity(h))
        sums.wall_push(walls, table, pressure, self._wall, self._wall_density, self.mass, fluid.viscosity)


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
