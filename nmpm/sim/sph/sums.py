"""The sums over pairs of a weakly compressible fluid's step, compiled, and the kernel that weights them.

The kernel is the quintic spline (Morris, Fox & Zhu 1997). With q = r / h it is
w(q) = (3 − q)⁵₊ − 6 (2 − q)⁵₊ + 15 (1 − q)⁵₊, W(r) = 7 / (478 π h²) · w(q). It is zero from `SUPPORT` smoothing lengths
on, its integral over the plane is one, and it has four continuous derivatives.

h is the smoothing length and equals the particles' spacing; m is a particle's mass, V = m / ρ its area and
F = W′(r) / r, so that ∇W = F (x_i − x_j). The F of a pair serves two sums, so it is kept. Tables hold a row each of the
particles' x, y, velocity along x and y, density, and acceleration along x and y.
"""

from __future__ import annotations

import math

from nmpm._support.jit import jit
from nmpm.sim.sph.neighbours import Pairs, WallPairs
from nmpm.sim.state import Array

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
