"""Runs of the material point method, frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nmpm.errors import DataError, UnstableError
from nmpm.scene import Interval
from nmpm.sim.arrays import Array
from nmpm.sim.mpm.particles import MpmParticles
from nmpm.sim.mpm.stepper import MpmStepper
from nmpm.sim.trajectory import Progress


def record_frames(
    stepper: MpmStepper,
    particles: MpmParticles,
    static: Array,
    frames: int,
    substeps: int,
    progress: Progress | None = None,
) -> NDArray[np.float32]:
    """Positions of `frames` + 1 frames, static particles (M, D) after the N moving ones: (frames + 1, N + M, D).

    Raises:
        DataError: if a particle starts inside an obstacle.
        UnstableError: if the state is no longer finite; the message names the substep.
    """
    stepper.enclose(particles)
    moving, dim = particles.position.shape
    recorded = np.empty((frames + 1, moving + len(static), dim), np.float32)
    recorded[0, :moving], recorded[:, moving:] = particles.position, static
    for frame in range(1, frames + 1):
        _advance_frame(stepper, particles, substeps, frame)
        recorded[frame, :moving] = particles.position
        if progress is not None:
            progress(frame)
    return recorded


def _advance_frame(stepper: MpmStepper, particles: MpmParticles, substeps: int, frame: int) -> None:
    for substep in range(substeps):
        try:
            stepper.step(particles)
        except FloatingPointError as error:
            raise UnstableError(
                f"{error} after substep {substep + 1} of {substeps} of frame {frame}; take more substeps, slower "
                "particles or a softer material."
            ) from error


def check_particles(position: NDArray[Any], velocity: NDArray[Any], reach: tuple[Interval, ...]) -> None:
    """Check the shapes of positions and velocities, and that there are particles, finite and within `reach`.

    Raises:
        DataError: if they are not.
    """
    if position.ndim != 2 or position.shape[1] != len(reach) or velocity.shape != position.shape:
        raise DataError(
            f"Positions {position.shape} and velocities {velocity.shape} must both have shape (N, {len(reach)})."
        )
    if not len(position):
        raise DataError("There is no particle to simulate: give the position of one at least.")
    low, high = np.array(reach).T
    inside = np.all((low <= position) & (position <= high) & np.isfinite(velocity), axis=1)
    if not inside.all():
        worst = int(np.argmin(inside))
        raise DataError(
            f"Particle {worst} at {position[worst].tolist()} with velocity {velocity[worst].tolist()} is not finite or "
            f"not within {reach}."
        )
