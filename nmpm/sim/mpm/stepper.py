"""One substep of the moving-least-squares material point method, in any dimension.

It scatters mass and momentum from the particles to a grid, with the stress as part of an affine momentum (Hu et al.,
"A moving least squares material point method with displacement discontinuity and two-way rigid body coupling", 2018),
applies gravity and the walls at the grid's nodes, and gathers velocity and its gradient back (APIC: Jiang et al., "The
affine particle-in-cell method", 2015). Kernels are quadratic B-splines.
"""

from __future__ import annotations

import abc

import numpy as np

from nmpm.errors import DataError
from nmpm.sim.arrays import Array
from nmpm.sim.mpm.grid import MpmGrid, Walls
from nmpm.sim.mpm.particles import MpmParticles

REVISION = 1
"""Increased whenever the same preset and seed give other numbers."""

# Distance from the box's sides, in cells, at which a particle is clamped. Float32 can still tell it from the side.
_MARGIN = 1e-4


class MpmStepper(abc.ABC):
    """Advances particles by substeps of one length.

    Args:
        grid: On which they move.
        dt: Length of a substep, in seconds.
    """

    def __init__(self, grid: MpmGrid, dt: float) -> None:
        self.grid = grid
        self.dt = dt
        self.held_back = 0
        """Particles clamped at the box's sides so far; the walls should make this unnecessary."""
        self.pushed_out = 0
        """Particles moved back to an obstacle's surface so far."""
        self._nodes: Array = np.zeros((*(cells + 2 for cells in grid.shape), len(grid.shape) + 1))
        self._lower = grid.low + _MARGIN * grid.size
        self._upper = grid.low + (np.array(grid.shape) - _MARGIN) * grid.size
        holds = grid.walls is not Walls.SEPARATE
        self._walls = (holds, int(holds), grid.walls is Walls.OPEN_CORNERS)

    def enclose(self, particles: MpmParticles) -> None:
        """Clamp particles to the box and push them out of obstacles; call it once before the first step.

        Raises:
            DataError: if a particle cannot be pushed out of an obstacle.
        """
        np.clip(particles.position, self._lower, self._upper, out=particles.position)
        obstacles = self.grid.obstacles
        if obstacles is not None:
            obstacles.push_out(
                particles.position.copy(), particles.position, particles.velocity, self._lower, self._upper
            )
            depth = obstacles.depth(particles.position)
            if depth.any():
                worst = int(np.argmax(depth))
                raise DataError(f"Particle {worst} at {particles.position[worst].tolist()} is inside an obstacle.")

    def step(self, particles: MpmParticles) -> None:
        """One substep, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        grid, dt = self.grid, self.dt
        for material, part in particles.parts:
            material.respond(particles.strain[part], particles.gradient[part], particles.stress[part], dt)
        self._scatter(particles)
        before = None
        if grid.obstacles is not None:
            before = particles.position.copy()
            grid.obstacles.brake(self._nodes, dt * grid.gravity)
        self._update_nodes()
        held_back = self._gather(particles)
        if held_back < 0:
            raise FloatingPointError("The state is not finite")
        self.held_back += held_back
        if grid.obstacles is not None and before is not None:
            self.pushed_out += grid.obstacles.push_out(
                before, particles.position, particles.velocity, self._lower, self._upper
            )

    @abc.abstractmethod
    def _scatter(self, particles: MpmParticles) -> None:
        """Sum mass and momentum of the particles at the nodes."""

    @abc.abstractmethod
    def _update_nodes(self) -> None:
        """Turn the nodes' momenta into velocities, under gravity and the walls."""

    @abc.abstractmethod
    def _gather(self, particles: MpmParticles) -> int:
        """Take velocities and their gradients from the nodes, and move the particles.

        Returns:
            How many particles were clamped to the box, or -1 if a position is not finite.
        """
