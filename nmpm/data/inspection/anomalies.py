"""Finds anomalies of a trajectory, as sentences that name trajectory, frame and particle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nmpm.data.format import Metadata, Trajectory
from nmpm.data.statistics import first_moving_particle

_JUMP = 5.0  # in spacings; a larger change between successive displacements of a particle is an anomaly


def find_anomalies(trajectory: Trajectory, metadata: Metadata, spacing: float, where: str) -> Iterator[str]:
    """Yields the anomalies of one trajectory.

    Args:
        trajectory: Read from the dataset.
        metadata: Of the dataset.
        spacing: Typical distance between neighbours, in domain length.
        where: Split and trajectory, to name in the sentences.
    """
    types, position = trajectory.particle_type, trajectory.position
    unknown = sorted(set(np.unique(types).tolist()) - set(metadata.particle_types))
    if unknown:
        yield f"{where}: type {', '.join(map(str, unknown))} is not in the metadata."
    moving = np.flatnonzero(np.isin(types, metadata.moving_types))
    if metadata.domain is not None:
        yield from _outside(position, metadata, where)
    yield from _jumps(position, moving, metadata, spacing, where)
    _, first, number = np.unique(position[0, moving], axis=0, return_index=True, return_counts=True)
    if (number > 1).any():
        twin = int(moving[first[int(np.argmax(number))]])
        twins = int((number - 1).sum())
        yield f"{where}, frame 0: {twins} particles have the position of another, e.g. of particle {twin}."
    static = np.isin(types, list(metadata.static_types))
    particle = first_moving_particle(position, static, metadata.bounds)
    if particle is not None:
        yield f"{where}: particle {particle}, of the static type {types[particle]}, moves."


def _outside(position: np.ndarray, metadata: Metadata, where: str) -> Iterator[str]:
    lower, upper = np.asarray(metadata.domain).T
    outside = (((position < lower) | (position > upper)) & ~np.asarray(metadata.periodic)).any(axis=-1)
    if outside.any():
        frame, particle = map(int, np.argwhere(outside)[0])
        yield (
            f"{where}, frame {frame}: particle {particle} is outside of the stated domain, at"
            f" {position[frame, particle].round(5).tolist()}; {int(outside.any(axis=0).sum())} particles leave it."
        )


def _jumps(position: np.ndarray, moving: np.ndarray, metadata: Metadata, spacing: float, where: str) -> Iterator[str]:
    change = np.diff(displacements(position[:, moving], metadata), axis=0)
    far = np.linalg.norm(change, axis=-1) > _JUMP * spacing
    if far.any():
        frame, index = map(int, np.argwhere(far)[0])
        jump = float(np.linalg.norm(change[frame, index]))
        yield (
            f"{where}: particle {int(moving[index])} jumps by {jump:.3g} between frames {frame + 1} and {frame + 2},"
            f" {jump / spacing:.0f} times the distance of neighbours ({int(far.any(axis=0).sum())} particles jump)."
        )


def displacements(position: np.ndarray, metadata: Metadata) -> np.ndarray:
    """(T - 1, N, D) displacements between successive frames, by minimum image on periodic axes."""
    lower, upper = np.asarray(metadata.bounds).T
    step: np.ndarray = np.diff(position.astype(np.float64), axis=0)
    for axis in np.flatnonzero(metadata.periodic):
        period = upper[axis] - lower[axis]
        step[..., axis] -= period * np.round(step[..., axis] / period)
    return step
