"""How long a substep of MLS-MPM may be, on cells of side h.

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

import math
from collections.abc import Sequence

from nmpm.sim.mpm.material import Material
from nmpm.sim.mpm.obstacle_field import lattice_margin

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
