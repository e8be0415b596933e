"""Runs of weakly compressible SPH, frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import DataError, UnstableError
from nmpm.scene import Interval
from nmpm.sim.sph.fluid import SphParticles
from nmpm.sim.sph.obstacles import PolygonObstacle
from nmpm.sim.sph.wcsph import SphStepper
from nmpm.sim.trajectory import Progress

DENSITY_LIMIT = 0.5
"""Largest deviation of a particle's density from that at rest, as a part of it; beyond, the run is unstable."""


def record_frames(
    stepper: SphStepper, particles: SphParticles, frames: int, substeps: int, progress: Progress | None = None
) -> tuple[NDArray[np.float32], float]:
    """Positions of `frames` + 1 frames, visible wall particles (M, 2) after the N moving ones: (frames + 1, N + M, 2).

    Returns:
        The positions, and the largest deviation of density, as a part of that at rest.

    Raises:
        UnstableError: if the simulation becomes unstable; the message names the frame.
    """
    stepper.initialise(particles)
    walls = stepper.boundary.position[stepper.boundary.visible]
    moving = len(particles.identity)
    recorded = np.empty((frames + 1, moving + len(walls), 2), np.float32)
    recorded[0, :moving], recorded[:, moving:] = particles.position, walls
    deviation = 0.0
    for frame in range(1, frames + 1):
        deviation = max(deviation, _advance_frame(stepper, particles, substeps, frame))
        recorded[frame, :moving] = particles.position
        if progress is not None:
            progress(frame)
    return recorded, deviation


def _advance_frame(stepper: SphStepper, particles: SphParticles, substeps: int, frame: int) -> float:
    """Simulate one frame; returns the largest deviation of density at its end."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # overflow is found below
            for _ in range(substeps):
                stepper.step(particles)
    except FloatingPointError as error:
        raise UnstableError(f"{error} in frame {frame}; take more substeps or a higher speed of sound.") from error
    rest, sound = stepper.fluid.density, stepper.fluid.speed_of_sound
    deviation = float(np.abs(particles.density / rest - 1).max())
    fastest = float(np.hypot(*particles.velocity.T).max())
    if not (deviation <= DENSITY_LIMIT and fastest <= sound):
        raise UnstableError(
            f"The simulation has blown up in frame {frame}: density deviates by {deviation:.0%} (limit "
            f"{DENSITY_LIMIT:.0%}), the fastest particle moves at {fastest:.3g} m/s (sound: {sound:.3g}). Take more "
            "substeps, a higher speed of sound or more viscosity, or leave this seed out."
        )
    outside = stepper.boundary.count_outside(particles.position)
    if outside:
        raise UnstableError(f"{outside} particles are outside of the box or in an obstacle in frame {frame}.")
    return deviation


def check_particles(
    position: NDArray[Any],
    velocity: NDArray[Any],
    box: tuple[Interval, Interval],
    obstacles: tuple[PolygonObstacle, ...],
) -> None:
    """Check the shapes of positions and velocities, and that there are particles, finite, in the box, in no obstacle.

    Raises:
        DataError: if they are not.
    """
    if position.ndim != 2 or position.shape[1] != 2 or velocity.shape != position.shape:
        raise DataError(f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, 2).")
    if not len(position):
        raise DataError("There is no particle to simulate: give the position of one at least.")
    low, high = np.array(box).T
    valid = np.all((low <= position) & (position <= high) & np.isfinite(velocity), axis=1)
    for obstacle in obstacles:
        valid[valid] &= obstacle.depth(position[valid]) <= 0
    if not valid.all():
        worst = int(np.argmin(valid))
        raise DataError(
            f"Particle {worst} at {position[worst].tolist()} with velocity {velocity[worst].tolist()} is not finite, "
            f"not within the box {box} or in an obstacle."
        )
