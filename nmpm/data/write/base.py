"""The interface of writers, and what they write: a clip, whose frames hold the particles that are there, in 3-D."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from nmpm._support.atomic import atomic_write, file_obstacle
from nmpm.data.format import ID, TRACK, TRUTH, Metadata, Trajectory
from nmpm.data.statistics import displacements


@dataclass(frozen=True)
class ClipFrame:
    """The n particles that are there in one frame."""

    number: int  # from 0 on
    time: float
    index: np.ndarray  # (n,) int64, of each particle in the trajectory, from 0 on
    id: np.ndarray  # (n,) int64 that the data call them by; the index where they have no numbers
    label: np.ndarray  # (n,) the same, or texts where the data call them by texts
    particle_type: np.ndarray  # (n,) int64
    position: np.ndarray  # (n, 3) float32; z is 0 in two dimensions
    fields: dict[str, np.ndarray]  # (n,) or, of vectors, (n, 3) by name; with `velocity`, in length per time


@dataclass(frozen=True)
class Clip:
    """A trajectory to be written, and what files hold beside its positions."""

    trajectory: Trajectory
    metadata: Metadata
    step: Callable[[], object] = lambda: None  # called after each frame

    @cached_property
    def times(self) -> np.ndarray:
        """(T,) float64: the recorded times, or else those of frames `dt` apart, from 0 on."""
        frames, stated = len(self.trajectory.position), np.asarray(self.trajectory.fields.get("time"))
        return stated.astype(np.float64) if stated.shape == (frames,) else np.arange(frames) * self.metadata.dt

    @property
    def spacing(self) -> float:
        """Distance between neighbours: of the stated volume, or else the first frame's median; 0 if unknown."""
        if self.metadata.particle_volume:
            return float(self.metadata.particle_volume ** (1 / self.metadata.dim))
        first = self.trajectory.position[0]
        first = first[~np.isnan(first[:, 0])]
        if len(first) < 2:
            return 0.0
        return float(np.median(cKDTree(first).query(first, k=2)[0][:, 1]))

    def step_all(self) -> None:
        """Steps once for each frame, where all are written at once."""
        for _ in self.times:
            self.step()

    def frames(self) -> Iterator[ClipFrame]:
        """Yields the frames, and steps after each; velocities that are not recorded are those of `velocities`."""
        trajectory, position, velocities = self.trajectory, self.trajectory.position, self.velocities()
        fields, ids, labels = particle_fields(trajectory), trajectory.ids(), trajectory.ids("iuS")
        for number, moment in enumerate(self.times):
            (index,) = np.nonzero(~np.isnan(position[number, :, 0]))
            now = {} if "velocity" in fields else {"velocity": next(velocities)}
            for name, values in fields.items():
                now[name] = values[number] if values.shape[:2] == position.shape[:2] else values
            yield ClipFrame(
                number,
                float(moment),
                index,
                ids[number, index],
                labels[number, index],
                trajectory.particle_type[index],
                pad(position[number, index]),
                {name: values[index] if values.ndim == 1 else pad(values[index]) for name, values in now.items()},
            )
            self.step()

    def velocities(self) -> Iterator[np.ndarray]:
        """Yields (N, D) float32 velocities of each frame, in length per time, as differences of positions.

        From the frame before; of particles that were not there, to the next; 0 if they are in neither.
        """
        position, times = self.trajectory.position, self.times
        for frame in range(len(times)):
            velocity = np.full(position.shape[1:], np.nan)
            for first in (frame - 1, frame):
                if 0 <= first < len(times) - 1:
                    duration = times[first + 1] - times[first]
                    step = displacements(position[first : first + 2], self.metadata)[0] / duration
                    velocity = np.where(np.isnan(velocity), step, velocity)
            yield np.nan_to_num(velocity).astype(np.float32)


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


def pad(vectors: np.ndarray) -> np.ndarray:
    """(n, 3) of (n, D) vectors, with zeros along the axes that are missing."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


class TrajectoryWriter(abc.ABC):
    """Abstract writer of trajectories into files that other programs read, one subclass per form.

    Attributes:
        readers: Programs that open the file, in words.
    """

    readers: ClassVar[str]

    @abc.abstractmethod
    def write(self, path: Path, clip: Clip) -> Path:
        """Writes a trajectory, whole or not at all, in place of a former file; returns the file to open.

        Raises:
            DataError or OSError: if it cannot be written.
        """

    def write_all(self, path: Path, clips: Iterable[Clip]) -> list[Path]:
        """As `write`, several trajectories into `paths`, each taken when the one before is written."""
        return [self.write(self.paths(path, number)[-1], clip) for number, clip in enumerate(clips, start=1)]

    def paths(self, path: Path, count: int) -> list[Path]:
        """The files of so many trajectories: a file for each, out-0.csv, out-1.csv, …, unless one holds them all."""
        return [path.with_stem(f"{path.stem}-{number}") for number in range(count)]

    def left_out(self, trajectory: Trajectory) -> set[str]:
        """Names of the fields that a file does not hold: those that are not of particles, and ids that are texts."""
        beside = {"time", TRACK, *({ID} if trajectory.fields.get(ID, np.zeros(0)).dtype.kind != "S" else ())}
        return set(trajectory.fields) - beside - set(particle_fields(trajectory))

    def obstacle(self, path: Path) -> str:
        """Why nothing can be written to a path, in words; empty if it can."""
        return file_obstacle(path)

    def hint(self, path: Path) -> str:
        """How to look at a written file."""
        return f"open {path} in {self.readers}"


class TextWriter(TrajectoryWriter):
    """Abstract writer of text."""

    @abc.abstractmethod
    def text(self, clip: Clip) -> Iterator[str]:
        """Yields the parts of the file."""

    def write(self, path: Path, clip: Clip) -> Path:
        with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
            file.writelines(self.text(clip))
        return path
