"""One substep of the moving-least-squares material point method, in any dimension.

It scatters mass and momentum from the particles to a grid, with the stress as part of an affine momentum (Hu et al.,
"A moving least squares material point method with displacement discontinuity and two-way rigid body coupling", 2018),
applies gravity and the walls at the grid's nodes, and gathers velocity and its gradient back (APIC: Jiang et al., "The
affine particle-in-cell method", 2015). Kernels are quadratic B-splines.

Nodes are the centres of square cells of size h that fill the box, and of one more cell around it, so that a particle in
cell i feels the nodes i, i + 1 and i + 2, counted from the outer cell. The wall acts at the centres of the outer and of
the first inner cells. A particle's velocity towards the wall then falls with the square of its distance from the box's
side, and it cannot cross. Walls that hold on to material act at the centres of the second inner cells as well, where
particles then stop; the box's sides are a cell further out.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm._support.jit import jit
from nmpm.errors import ConfigError, DataError, UnstableError
from nmpm.sim.mpm import kernels_2d, kernels_3d
from nmpm.sim.mpm.kernels_2d import Cells
from nmpm.sim.mpm.material import Material
from nmpm.sim.mpm.obstacle_field import ObstacleField
from nmpm.sim.state import Array

# Distance from the box's sides, in cells, at which a particle is clamped. Float32 can still tell it from the side.
_MARGIN = 1e-4


class Walls(enum.Enum):
    """What the box's sides do with material that moves away from them."""

    SEPARATE = "separate"
    """Let it go: they push and brake, and never pull."""

    SLIP = "slip"
    """Hold it, so that it only slides along."""

    OPEN_CORNERS = "slip, open corners"
    """Hold it; but at the very corner, the first node of both walls, along the first axis alone, so that material that
    slides down a side is not stopped a cell above the floor. The solver of DeepMind's recorded water does so."""


@dataclass(frozen=True)
class MpmGrid:
    """Square cells, cubes in three dimensions, that fill a box.

    Args:
        low: (D,) lower corner of the box, in length.
        size: Side of a cell, in length.
        shape: Cells along each axis.
        friction: Coulomb friction of the walls.
        gravity: (D,) acceleration, in length per second squared.
        walls: How the box's sides treat material.
        obstacles: Within the box; None without.
    """

    low: Array
    size: float
    shape: tuple[int, ...]
    friction: float
    gravity: Array
    walls: Walls = Walls.SEPARATE
    obstacles: ObstacleField | None = None


class MpmParticles:
    """N moving particles in D dimensions, sorted by material; a substep changes them in place.

    Args:
        position: (N, D) in length.
        velocity: (N, D) in length per second.
        groups: Material and number of particles of each group, in the particles' order.
        volume: Area of a particle at rest, or volume in three dimensions.
    """

    def __init__(
        self, position: NDArray[Any], velocity: NDArray[Any], groups: tuple[tuple[Material, int], ...], volume: float
    ) -> None:
        count, dim = position.shape
        numbers = [number for _, number in groups]
        self.position = np.array(position, dtype=np.float64, order="C")
        self.velocity = np.array(velocity, dtype=np.float64, order="C")
        self.gradient: Array = np.zeros((count, dim, dim))
        # As wide as the widest material's; the other materials do not use the last columns.
        rests = [material.rest(dim) for material, _ in groups]
        padded = [rest + (0.0,) * (max(map(len, rests)) - len(rest)) for rest in rests]
        self.strain: Array = np.repeat(np.array(padded), numbers, axis=0)
        self.stress: Array = np.zeros((count, dim * (dim + 1) // 2))
        self.volume = volume
        self.mass: Array = np.repeat([material.density * volume for material, _ in groups], numbers)
        ends = np.cumsum([0, *numbers])
        self.parts = tuple((m, slice(a, b)) for (m, _), a, b in zip(groups, ends[:-1], ends[1:], strict=True))
        """Each material with the slice of its particles."""


class MpmStepper:
    """Advances particles by substeps of one length.

    Args:
        grid: On which they move.
        dt: Length of a substep, in seconds.

    Raises:
        ConfigError: if the grid has three dimensions, and open corners.
    """

    def __init__(self, grid: MpmGrid, dt: float) -> None:
        dim, in_corners = len(grid.shape), grid.walls is Walls.OPEN_CORNERS
        if dim == 3 and in_corners:
            raise ConfigError("Open corners are implemented in two dimensions, not in three.")
        self.grid = grid
        self.dt = dt
        self.held_back = 0
        """Particles clamped at the box's sides so far; the walls should make this unnecessary."""
        self.pushed_out = 0
        """Particles moved back to an obstacle's surface so far."""
        self._kernels: Any = kernels_2d if dim == 2 else kernels_3d
        self._nodes: Array = np.zeros((*(cells + 2 for cells in grid.shape), dim + 1))
        self._window: NDArray[np.int64] = np.zeros((2, dim), np.int64)
        lower = grid.low + _MARGIN * grid.size
        upper = grid.low + (np.array(grid.shape) - _MARGIN) * grid.size
        self._cells = Cells(grid.low, grid.size, lower, upper)
        holds = grid.walls is not Walls.SEPARATE
        self._walls = (holds, int(holds), in_corners)

    def enclose(self, particles: MpmParticles) -> None:
        """Clamp particles to the box and push them out of obstacles; call it once before the first step.

        Raises:
            DataError: if a particle cannot be pushed out of an obstacle.
        """
        lower, upper = self._cells.lower, self._cells.upper
        np.clip(particles.position, lower, upper, out=particles.position)
        obstacles = self.grid.obstacles
        if obstacles is not None:
            obstacles.push_out(particles.position.copy(), particles.position, particles.velocity, lower, upper)
            depth = obstacles.depth(particles.position)
            if depth.any():
                worst = int(np.argmax(depth))
                raise DataError(f"Particle {worst} at {particles.position[worst].tolist()} is inside an obstacle.")

    def step(self, particles: MpmParticles) -> None:
        """One substep, in place.

        Raises:
            FloatingPointError: if a position is no longer finite.
        """
        grid, dt, nodes, window = self.grid, self.dt, self._nodes, self._window
        for material, part in particles.parts:
            material.respond(particles.strain[part], particles.gradient[part], particles.stress[part], dt)
        position, velocity = particles.position, particles.velocity
        motion = position, velocity, particles.gradient
        _find_window(position, grid.low, grid.size, window)
        self._kernels.scatter(
            nodes, window, self._cells, dt * particles.volume, motion, particles.stress, particles.mass
        )
        before = None
        if grid.obstacles is not None:
            before = position.copy()
            grid.obstacles.brake(nodes, dt * grid.gravity)
        self._kernels.update_nodes(nodes, window, dt * grid.gravity, grid.friction, *self._walls)
        held_back = self._kernels.gather(nodes, self._cells, dt, motion)
        if held_back < 0:
            raise FloatingPointError("The state is not finite")
        self.held_back += held_back
        if grid.obstacles is not None and before is not None:
            self.pushed_out += grid.obstacles.push_out(before, position, velocity, self._cells.lower, self._cells.upper)

    def advance_frame(self, particles: MpmParticles, substeps: int, frame: int) -> None:
        """The substeps of a frame, in place.

        Raises:
            UnstableError: if the state is no longer finite; the message names frame and substep.
        """
        for substep in range(substeps):
            try:
                self.step(particles)
            except FloatingPointError as error:
                raise UnstableError(
                    f"{error} after substep {substep + 1} of {substeps} of frame {frame}; take more substeps, slower "
                    "particles or a softer material."
                ) from error


@jit
def _find_window(position: Array, low: Array, size: float, window: NDArray[np.int64]) -> None:
    """Write the first node of the particles along each axis, and the one after the last."""
    for axis in range(position.shape[1]):
        least = most = position[0, axis]
        for p in range(1, position.shape[0]):
            least, most = min(least, position[p, axis]), max(most, position[p, axis])
        window[0, axis], window[1, axis] = int((least - low[axis]) / size), int((most - low[axis]) / size) + 3
