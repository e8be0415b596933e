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
velocity in between, acceleration anew, and the second half of it. Pairs are listed within a margin beyond the kernel's
reach, and listed anew once a particle has moved by half of it.

*Pairs* of particles that are near each other are found through a grid of square cells as large as the reach. Particles
are sorted by cell, row after row. The neighbours of a particle then lie in three runs of indices, one for each row of
cells around it, and every pair is found once, from the particle that comes first.

*The kernel* is the quintic spline (Morris, Fox & Zhu 1997). With q = r / h it is
w(q) = (3 − q)⁵₊ − 6 (2 − q)⁵₊ + 15 (1 − q)⁵₊, W(r) = 7 / (478 π h²) · w(q). It is zero from `SUPPORT` smoothing lengths
on, its integral over the plane is one, and it has four continuous derivatives.

h is the smoothing length and equals the particles' spacing; m is a particle's mass, V = m / ρ its area and
F = W′(r) / r, so that ∇W = F (x_i − x_j). The F of a pair serves two sums, so it is kept. Tables hold a row each of the
particles' x, y, velocity along x and y, density, and acceleration along x and y.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.errors import UnstableError
from nmpm.sim.sph.boundary import SolidBoundary
from nmpm.sim.state import Array, check_numbers

Indices = NDArray[np.uint32]


class Pairs(NamedTuple):
    """K pairs of fluid particles; arrays of shape (K,), the last four written by `pair_geometry` and `expansion`.

    `dx` and `dy` are differences of position, first minus second; `drag` is F v · x / (r² + 0.01 h²), for viscosity.
    """

    first: Indices
    second: Indices
    dx: Array
    dy: Array
    f: Array
    drag: Array


class WallPairs(NamedTuple):
    """K pairs of a fluid and a wall particle, likewise by `wall_geometry`; `w` is W."""

    first: Indices
    second: Indices
    dx: Array
    dy: Array
    f: Array
    w: Array


class Bins(NamedTuple):
    """Square cells, numbered row after row from the lower left corner."""

    left: float
    bottom: float
    per_length: float
    columns: int


class PairLists:
    """Lists pairs of particles near each other and near the walls, in memory that it reuses.

    The cells cover the walls, with one more ring of cells that stay empty.

    Args:
        walls: (M, 2) positions of the wall particles, which surround all others.
        reach: Distance within which pairs are listed, in length.
    """

    def __init__(self, walls: Array, reach: float) -> None:
        low, high = walls.min(0), walls.max(0)
        columns, self._rows = (int(n) + 4 for n in (high - low) / reach)
        left, bottom = (low - 1.001 * reach).tolist()
        # Reduced slightly so that rounding never puts a pair two cells apart.
        self._cells, self._reach = Bins(left, bottom, (1.0 - 1e-9) / reach, columns), reach
        order, self._wall_starts = self.sort_by_cell(*np.ascontiguousarray(walls.T))
        self.wall_x, self.wall_y = np.ascontiguousarray(walls[order].T)
        """(M,) positions of the wall particles in the order that pairs refer to."""
        self._memory, self._wall_memory = np.empty((2, 1024), np.uint32), np.empty((2, 1024), np.uint32)

    def sort_by_cell(self, x: Array, y: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Order of the particles by cell, and where each cell's run of them starts (cells + 1 numbers).

        Particles must lie within the walls; within a cell they keep their order.
        """
        order = np.empty(len(x), np.int64)
        starts = np.zeros(self._cells.columns * self._rows + 2, np.int64)
        _sort(x, y, self._cells, order, starts)
        return order, starts[:-1]

    def near(self, x: Array, y: Array, starts: NDArray[np.int64]) -> tuple[Pairs, WallPairs]:
        """Every pair of sorted particles once, and every pair of one and a wall particle; valid until the next call."""
        cells, reach, walls = self._cells, self._reach, (self.wall_x, self.wall_y, self._wall_starts)
        self._memory, count = _fill(self._memory, lambda memory: _pairs_within(x, y, starts, cells, reach, memory))
        self._wall_memory, wet = _fill(
            self._wall_memory, lambda memory: _pairs_between(x, y, *walls, cells, reach, memory)
        )
        return (
            Pairs(*self._memory[:, :count], *np.empty((4, count))),
            WallPairs(*self._wall_memory[:, :wet], *np.empty((4, wet))),
        )


def _fill(memory: Indices, fill: Callable[[Indices], int]) -> tuple[Indices, int]:
    """The memory with the pairs, larger if they need more, and their number."""
    count = fill(memory)
    if count >= memory.shape[1]:
        memory = np.empty((2, count + count // 4 + 1), np.uint32)
        fill(memory)
    return memory, count


@jit
def _cell(x: float, y: float, cells: Bins) -> int:
    row, column = int((y - cells.bottom) * cells.per_length), int((x - cells.left) * cells.per_length)
    return row * cells.columns + column


@jit
def _sort(x: Array, y: Array, cells: Bins, order: NDArray[np.int64], starts: NDArray[np.int64]) -> None:
    """Counting sort; `starts` has two more entries than cells, and ends up shifted by one for the filling."""
    cell_of = np.empty(x.shape[0], np.int64)
    for i in range(x.shape[0]):
        cell_of[i] = _cell(x[i], y[i], cells)
        starts[cell_of[i] + 2] += 1
    for c in range(2, starts.shape[0]):
        starts[c] += starts[c - 1]
    for i in range(x.shape[0]):
        order[starts[cell_of[i] + 1]] = i
        starts[cell_of[i] + 1] += 1


# Both count the pairs, and store them if there is more room: every candidate is written, and those too far away are
# overwritten.


@jit
def _pairs_within(x: Array, y: Array, starts: NDArray[np.int64], cells: Bins, reach: float, memory: Indices) -> int:
    reach2, last, count, columns = reach * reach, memory.shape[1] - 1, 0, cells.columns
    for i in range(x.shape[0]):
        xi, yi = x[i], y[i]
        cell = _cell(xi, yi, cells)
        for row in range(2):
            begin = i + 1 if row == 0 else starts[cell + columns - 1]
            for j in range(begin, starts[cell + row * columns + 2]):
                dx, dy = xi - x[j], yi - y[j]
                slot = min(count, last)
                memory[0, slot], memory[1, slot] = i, j
                count += dx * dx + dy * dy < reach2
    return count


@jit
def _pairs_between(
    x: Array, y: Array, wall_x: Array, wall_y: Array, starts: NDArray[np.int64],
    cells: Bins, reach: float, memory: Indices,
) -> int:  # fmt: skip
    reach2, last, count, columns = reach * reach, memory.shape[1] - 1, 0, cells.columns
    for i in range(x.shape[0]):
        xi, yi = x[i], y[i]
        cell = _cell(xi, yi, cells)
        for row in range(-1, 2):
            middle = cell + row * columns
            for j in range(starts[middle - 1], starts[middle + 2]):
                dx, dy = xi - wall_x[j], yi - wall_y[j]
                slot = min(count, last)
                memory[0, slot], memory[1, slot] = i, j
                count += dx * dx + dy * dy < reach2
    return count


SUPPORT = 3.0
"""Reach of the kernel, in smoothing lengths."""

NORM = 7.0 / (478.0 * math.pi)
"""W = NORM / h² · w(q)."""

# Particles on the same spot have no direction to push each other in: a tiny distance, squared, keeps F finite.
_SAME_SPOT = 1e-24


@jit
def weight(q: float) -> float:
    """The spline w at q ≥ 0, not normalised."""
    outer, middle, inner = max(0.0, 3.0 - q), max(0.0, 2.0 - q), max(0.0, 1.0 - q)
    outer2, middle2, inner2 = outer * outer, middle * middle, inner * inner
    return outer2 * outer2 * outer - 6.0 * (middle2 * middle2 * middle) + 15.0 * (inner2 * inner2 * inner)


@jit
def slope(q: float) -> float:
    """Its derivative dw / dq at q ≥ 0."""
    outer, middle, inner = max(0.0, 3.0 - q), max(0.0, 2.0 - q), max(0.0, 1.0 - q)
    outer2, middle2, inner2 = outer * outer, middle * middle, inner * inner
    return -5.0 * (outer2 * outer2 - 6.0 * (middle2 * middle2) + 15.0 * (inner2 * inner2))


@jit
def pair_geometry(table: Array, pairs: Pairs, h: float) -> None:
    """Write difference of position and F of each pair."""
    x, y = table[0], table[1]
    first, second, dx, dy, f = pairs.first, pairs.second, pairs.dx, pairs.dy, pairs.f
    inverse = 1.0 / h
    scale = NORM * inverse**3
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        dx[k], dy[k] = x[i] - x[j], y[i] - y[j]
    # A loop of its own, free of look-ups, is done several pairs at a time.
    for k in range(f.shape[0]):
        r = math.sqrt(dx[k] * dx[k] + dy[k] * dy[k] + _SAME_SPOT)
        f[k] = scale * slope(r * inverse) / r


@jit
def wall_geometry(table: Array, wall_x: Array, wall_y: Array, pairs: WallPairs, h: float) -> None:
    """Write difference of position, F and W of each pair with a wall particle."""
    x, y = table[0], table[1]
    first, second, dx, dy, f, w = pairs
    inverse = 1.0 / h
    scale, norm = NORM * inverse**3, NORM * inverse**2
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        dx[k], dy[k] = x[i] - wall_x[j], y[i] - wall_y[j]
        r = math.sqrt(dx[k] * dx[k] + dy[k] * dy[k] + _SAME_SPOT)
        f[k], w[k] = scale * slope(r * inverse) / r, norm * weight(r * inverse)


@jit
def expansion(
    pairs: Pairs, table: Array, mass: float, diffusion: float, layering: Array, soft: float, rate: Array
) -> None:
    """Adds Σ V_j F v_ij · x_ij, the rate at which density grows per density (Monaghan 2005), to `rate`.

    To that comes diffusion of density, Σ V_j F `diffusion` (ρ_ij − ρ^H_ij), where ρ^H is the density of water at rest,
    whose gradient is `layering` (Fourtakas, Dominguez, Vacondio & Rogers 2019). Writes the pairs' `drag`, with `soft`
    for 0.01 h².
    """
    first, second, dx, dy, f, drag = pairs
    vx, vy, density = table[2], table[3], table[4]
    volume = mass / density
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        approach = f[k] * ((vx[i] - vx[j]) * dx[k] + (vy[i] - vy[j]) * dy[k])
        drag[k] = approach
        uneven = density[i] - density[j] - layering[0] * dx[k] - layering[1] * dy[k]
        flux = diffusion * f[k] * uneven
        rate[i] += volume[j] * (approach + flux)
        rate[j] += volume[i] * (approach - flux)
    for k in range(drag.shape[0]):
        drag[k] /= dx[k] * dx[k] + dy[k] * dy[k] + soft


@jit
def wall_expansion(pairs: WallPairs, table: Array, wall_volume: Array, rate: Array) -> None:
    """The walls' part of `expansion`: they stand still."""
    first, second, dx, dy, f = pairs.first, pairs.second, pairs.dx, pairs.dy, pairs.f
    vx, vy = table[2], table[3]
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        rate[i] += wall_volume[j] * f[k] * (vx[i] * dx[k] + vy[i] * dy[k])


@jit
def push(pairs: Pairs, table: Array, pressure: Array, mass: float, viscosity: float) -> None:
    """Adds the accelerations of pressure (Adami et al. 2012, equations 6 and 7) and viscosity.

    Viscosity is Monaghan's (2005, equation 4.2), whether pairs approach or part; `viscosity` stands for
    α h c plus eight times the kinematic viscosity. Both act along the line between two particles, so that momentum and
    angular momentum are kept.
    """
    first, second, dx, dy, f, drag = pairs
    density, ax, ay = table[4], table[5], table[6]
    areas = 1.0 / (density * density)
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        ri, rj = density[i], density[j]
        mean = rj * pressure[i] + ri * pressure[j]
        strength = mass * (2.0 * viscosity * drag[k] - (areas[i] + areas[j]) * mean * f[k]) / (ri + rj)
        ax[i] += strength * dx[k]
        ay[i] += strength * dy[k]
        ax[j] -= strength * dx[k]
        ay[j] -= strength * dy[k]


@jit
def wall_averages(pairs: WallPairs, table: Array, pressure: Array, gravity: Array, wall: Array) -> None:
    """Pressure and velocity of the walls, continued from the fluid (Adami et al. 2012, equations 22, 23 and 27).

    Rows of `wall` become pressure, velocity along x and y, and the sum of the weights; 0 where no fluid is near.
    """
    first, second, dx, dy, w = pairs.first, pairs.second, pairs.dx, pairs.dy, pairs.w
    vx, vy, density = table[2], table[3], table[4]
    wall[:] = 0.0
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        fall = density[i] * (gravity[0] * dx[k] + gravity[1] * dy[k])
        wall[0, j] += w[k] * (pressure[i] - fall)
        wall[1, j] -= w[k] * vx[i]
        wall[2, j] -= w[k] * vy[i]
        wall[3, j] += w[k]
    for j in range(wall.shape[1]):
        if wall[3, j] > 0.0:
            for row in range(3):
                wall[row, j] /= wall[3, j]


@jit
def wall_push(
    pairs: WallPairs, table: Array, pressure: Array, wall: Array, wall_density: Array, mass: float, viscosity: float
) -> None:
    """Adds the walls' pressure and, with the dynamic viscosity, their no-slip drag (Adami et al. 2012, equation 8)."""
    first, second, dx, dy, f = pairs.first, pairs.second, pairs.dx, pairs.dy, pairs.f
    vx, vy, density, ax, ay = table[2], table[3], table[4], table[5], table[6]
    for k in range(first.shape[0]):
        i, j = first[k], second[k]
        ri, rj = density[i], wall_density[j]
        mean = (rj * pressure[i] + ri * wall[0, j]) / (ri + rj)
        areas = mass * f[k] * (1.0 / (ri * ri) + 1.0 / (rj * rj))
        ax[i] += areas * (viscosity * (vx[i] - wall[1, j]) - mean * dx[k])
        ay[i] += areas * (viscosity * (vy[i] - wall[2, j]) - mean * dy[k])


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
        pair_geometry(table, pairs, h)
        wall_geometry(table, self._lists.wall_x, self._lists.wall_y, walls, h)
        rate, diffusion = np.zeros_like(density), 2 * fluid.diffusion * h * sound / rest
        expansion(pairs, table, self.mass, diffusion, rest / sound**2 * self.gravity, 0.01 * h * h, rate)
        wall_expansion(walls, table, self.mass / self._wall_density, rate)
        density *= 1.0 + dt * rate
        kept = np.exp(-dt * sound / (_FADING * h))
        density[self._spray] = rest + kept * np.maximum(density[self._spray] - rest, 0.0)
        pressure = _pressure(density, rest, sound, fluid.exponent)
        wall_averages(walls, table, pressure, self.gravity, self._wall)
        self._wall_density = _density(self._wall[0], rest, sound, fluid.exponent)
        table[5:7] = self.gravity[:, None]
        push(pairs, table, pressure, self.mass, 8 * fluid.kinematic_viscosity(h))
        wall_push(walls, table, pressure, self._wall, self._wall_density, self.mass, fluid.viscosity)


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
