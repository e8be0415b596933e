"""A trajectory frame by frame, as other programs hold it: the particles that are there, in three dimensions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nmpm.data.format import ID, TRACK, TRUTH, Metadata, Trajectory
from nmpm.data.statistics import displacements


@dataclass(frozen=True)
class Frame:
    """The n particles that are there in one frame."""

    number: int  # from 0 on
    time: float
    index: np.ndarray  # (n,) int64, of each particle in the trajectory, from 0 on
    id: np.ndarray  # (n,) int64 that the data call them by; the index where they have no numbers
    label: np.ndarray  # (n,) the same, or texts where the data call them by texts
    particle_type: np.ndarray  # (n,) int64
    position: np.ndarray  # (n, 3) float32; z is 0 in two dimensions
    fields: dict[str, np.ndarray]  # (n,) or, of vectors, (n, 3) by name; with `velocity`, in length per time


def frame_times(trajectory: Trajectory, metadata: Metadata) -> np.ndarray:
    """(T,) float64: the recorded times, or else those of frames `dt` apart, from 0 on."""
    frames, stated = len(trajectory.position), np.asarray(trajectory.fields.get("time"))
    return stated.astype(np.float64) if stated.shape == (frames,) else np.arange(frames) * metadata.dt


def particle_fields(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """The fields that have a number or a vector for each particle, (T, N), (N,), (T, N, D) or (N, D), by name.

    A truth of other frames is cut, or NaN in frames that it lacks.
    """
    frames, particles, dim = trajectory.position.shape
    shapes = [(frames, particles), (particles,), (frames, particles, dim), (particles, dim)]
    beside = ("time", ID, TRACK)
    fields = {name: np.asarray(values) for name, values in trajectory.fields.items() if name not in beside}
    if TRUTH in fields and fields[TRUTH].shape[1:] == (particles, dim):
        truth = np.full((frames, particles, dim), np.nan, dtype=np.float32)
        truth[: len(fields[TRUTH])] = fields[TRUTH][:frames]
        fields[TRUTH] = truth
    return {name: values for name, values in fields.items() if values.shape in shapes and values.dtype.kind in "biuf"}


def fields_left_out(trajectory: Trajectory) -> list[str]:
    """Names of the fields that frames do not have, as they are not of particles or of other frames."""
    beside = {"time", TRACK, *({ID} if trajectory.fields.get(ID, np.zeros(0)).dtype.kind != "S" else ())}
    return sorted(set(trajectory.fields) - beside - set(particle_fields(trajectory)))


def frames(trajectory: Trajectory, metadata: Metadata) -> Iterator[Frame]:
    """Yields the frames; velocities that are not recorded are those of `frame_velocities`."""
    position, fields = trajectory.position, particle_fields(trajectory)
    velocities = frame_velocities(trajectory, metadata)
    ids, labels = trajectory.ids(), trajectory.ids("iuS")
    for number, moment in enumerate(frame_times(trajectory, metadata)):
        (index,) = np.nonzero(~np.isnan(position[number, :, 0]))
        velocity = {} if "velocity" in fields else {"velocity": next(velocities)}
        now = velocity | {name: _at(values, number, position.shape) for name, values in fields.items()}
        yield Frame(
            number,
            float(moment),
            index,
            ids[number, index],
            labels[number, index],
            trajectory.particle_type[index],
            pad(position[number, index]),
            {name: values[index] if values.ndim == 1 else pad(values[index]) for name, values in now.items()},
        )


def pad(vectors: np.ndarray) -> np.ndarray:
    """(n, 3) of (n, D) vectors, with zeros along the axes that are missing."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def particle_spacing(trajectory: Trajectory, metadata: Metadata) -> float:
    """The distance between neighbours: stated as their volume, or else the median in the first frame; 0 if unknown."""
    if metadata.particle_volume:
        return float(metadata.particle_volume ** (1 / metadata.dim))
    first = trajectory.position[0][~np.isnan(trajectory.position[0, :, 0])]
    if len(first) < 2:
        return 0.0
    return float(np.median(cKDTree(first).query(first, k=2)[0][:, 1]))


def _at(values: np.ndarray, frame: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray(values[frame] if values.shape[:2] == shape[:2] else values)


def frame_velocities(trajectory: Trajectory, metadata: Metadata) -> Iterator[np.ndarray]:
    """Yields (N, D) float32 velocities of each frame, in length per time, as differences of positions.

    From the frame before; of particles that were not there, to the next; 0 if they are in neither.
    """
    position, times = trajectory.position, frame_times(trajectory, metadata)
    for frame in range(len(times)):
        velocity = np.full(position.shape[1:], np.nan)
        for first in (frame - 1, frame):
            if 0 <= first < len(times) - 1:
                step = displacements(position[first : first + 2], metadata)[0] / (times[first + 1] - times[first])
                velocity = np.where(np.isnan(velocity), step, velocity)
        yield np.nan_to_num(velocity).astype(np.float32)
