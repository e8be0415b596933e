"""Streams opened datasets into the native layout, or into files for other programs, and renumbers particle types."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from nmpm._support.atomic import new_folder
from nmpm._support.messages import span
from nmpm._support.progress import progress_bar
from nmpm.data.array_checks import check_end, swapped_axes
from nmpm.data.convert.base import UNKNOWN_LENGTH, ForeignDataset
from nmpm.data.facts import FactFinder
from nmpm.data.format import SPLITS, Metadata, Split, Trajectory, write_metadata, write_split
from nmpm.data.metadata import FOUND
from nmpm.data.stated import AXES
from nmpm.data.statistics import (
    STATISTICS_KEYS,
    Extent,
    MotionStatistics,
    count_gone,
    find_disagreements,
    first_moving_particle,
    notes_on_lengths,
    notes_on_rounding,
)
from nmpm.data.write import find_writer, write_trajectory
from nmpm.data.write.base import Clip
from nmpm.errors import ConfigError, DataError

NOTES = "conversion"
STATED = "stated_statistics"
MOVING_BOUNDARIES = "moving_boundaries"
_SAMPLE_BYTES = 2**28
_PLAIN_TO_SEE: tuple[Any, ...] = (frozenset(), {0: "particles"})
_MOVE_STATISTICS = {"bounds", "boundary", "particle_types", "static_types"}
"""Facts that displacements of moving particles depend on."""


def write_native(source: ForeignDataset, destination: Path, problems: list[str] | None = None) -> tuple[str, ...]:
    """Writes an opened dataset into a folder that is new or empty, and returns notes for the user.

    Args:
        source: The dataset.
        destination: The folder.
        problems: Collects what is wrong with trajectories; of each split those before the first that cannot be read
            are written. When left out, the first problem is raised.

    Raises:
        DataError: if the destination exists or cannot be written, or the source is damaged; nothing is left then.
    """
    destination = Path(destination)
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        raise DataError(f"{destination}: exists already; choose another folder, or delete this one.")
    names = [name for name in SPLITS if name in source.splits]
    total, log = sum(source.counts.get(name, 0) for name in names) or None, _Log(source, problems)
    try:
        with new_folder(destination) as folder:
            with progress_bar("Converting", total) as advance:
                for name in names:
                    before = log.number
                    try:
                        write_split(folder / f"{name}.h5", log.watch(source.splits[name](), name, advance))
                    except DataError:
                        if not problems or log.number > before:
                            raise
                    # The statistics are those of the first split, train where there is one.
                    log.statistics = log.statistics or log.motion.result()
            if problems and not log.number:
                raise DataError(problems[0])
            if log.frames == {1}:
                raise DataError(f"{names[0]} split: its trajectories have one frame each; motion needs two or more.")
            if source.unknown:
                log.find_unknown(Split(folder / f"{names[0]}.h5"))
            if source.steps and (apart := log.finder.recorded_step):  # frames are by the number of steps
                for name in names:
                    with h5py.File(folder / f"{name}.h5", "r+") as file:
                        for times in (group["time"] for group in file.values() if "time" in group):
                            times[...] = log.metadata.dt / apart * times[()]
            metadata, notes = log.final_metadata()
            write_metadata(folder, replace(metadata, extra=metadata.extra | {NOTES: [*source.notes, *notes]}))
    except OSError as error:
        raise DataError(f"{destination}: cannot be written ({error}).") from error
    return (*source.notes, *notes, *log.extent.notes(metadata), *notes_on_rounding(metadata))


class _Log:
    """Collects facts about the trajectories of a conversion.

    Args:
        source: The dataset.
        problems: Collects what is wrong with trajectories; None raises it.
    """

    def __init__(self, source: ForeignDataset, problems: list[str] | None) -> None:
        self.metadata, self.unknown, self.problems = source.metadata, source.unknown, problems
        self.motion, self.statistics = MotionStatistics(self.metadata), dict[str, list[float]]()
        self.number = self.moving_boundaries = self.particles = 0
        self.frames: set[int] = set()
        self.swapped = ""  # why axes look swapped
        self.extent = Extent(self.metadata.dim)
        dt = None if "dt" in self.unknown else self.metadata.dt
        boundary = None if "boundary" in self.unknown else self.metadata.boundary
        self.finder = FactFinder(self.metadata.dim, dt, self.metadata.obstacle_types, boundary, source.steps)
        self._facts: list[str] = []

    def watch(
        self, trajectories: Iterable[Trajectory], split: str, advance: Callable[[], object]
    ) -> Iterator[Trajectory]:
        """Yields the trajectories of a split, up to one that is damaged where problems are collected."""
        try:
            for index, trajectory in enumerate(trajectories):
                self._add(trajectory, f"{split} split, trajectory {index}")
                yield trajectory
                advance()
        except DataError as error:
            if self.problems is None:
                raise
            self.problems.append(f"{error} Trajectories after it are not read." if self.number else str(error))

    def _add(self, trajectory: Trajectory, where: str) -> None:
        types, position, metadata = trajectory.particle_type, trajectory.position, self.metadata
        if position.shape[2] != metadata.dim:
            raise DataError(f"{where}: positions have {position.shape[2]} axes, the metadata has dim = {metadata.dim}.")
        if self.unknown:
            self.finder.add(trajectory)
            if "gravity" in trajectory.attributes:
                self.unknown -= {"gravity"}
        if self.problems is None and "particle_types" not in self.unknown:
            metadata.check_types(types, where)
        if not self.statistics:
            self.motion.add(trajectory)
        if AXES not in metadata.extra and not np.ptp(types) and not self.swapped:
            self.swapped = swapped_axes(position) and f"{where}: {swapped_axes(position)}"
        static, moving = metadata.is_static(types), metadata.is_moving(types)
        if moving.any():
            check_end(position[:, moving], where)
        self.number += 1
        self.moving_boundaries += first_moving_particle(position, static, metadata.bounds) is not None
        self.extent.add(position[:, metadata.is_obstacle(types) | moving])
        self.extent.gone += count_gone(position[:, moving], metadata)
        self.frames.add(len(position))
        self.particles = max(self.particles, position.shape[1])

    def find_unknown(self, split: Split) -> None:
        """Completes the metadata by facts about the trajectories; `split` is the first one, as written."""
        facts = self.finder.facts()
        self.metadata = facts.complete(self.metadata, self.unknown)
        self._facts = [
            f"{name} {_short(name, getattr(self.metadata, name))} ({how.rstrip('.')})."
            for name, how in self.metadata.extra[FOUND].items()
            if getattr(self.metadata, name) not in _PLAIN_TO_SEE and name != "sequence_length"
        ]
        if still := facts.unmoving:
            self._facts.append(
                f"{still.count} particles of moving types never move (in trajectory {still.trajectory}, e.g. particle"
                f" {still.particle}). If they are walls, give them a type of their own."
            )
        if self.unknown & _MOVE_STATISTICS:
            self.motion = MotionStatistics(self.metadata)
            for index in split.sample(_SAMPLE_BYTES):
                self.motion.add(split.read(index))
            self.statistics = self.motion.result()

    def final_metadata(self) -> tuple[Metadata, list[str]]:
        """The metadata with the measured statistics, and notes on inconsistencies."""
        extra = dict(self.metadata.extra)
        stated = {key: extra[key] for key in STATISTICS_KEYS if key in extra}
        notes = find_disagreements(self.statistics, stated)
        if notes:
            notes.append(f"The stated values are kept as {STATED!r}.")
        if stated:
            extra[STATED] = stated
        extra |= self.statistics | {"num_particles_max": self.particles}
        if self.moving_boundaries:
            extra[MOVING_BOUNDARIES] = True
            notes.append(
                f"Particles of a static type move in {self.moving_boundaries} of {self.number} trajectories. Their"
                " positions are kept; to train on them, state which types are static (--static), and which move as"
                " recorded (--prescribed)."
            )
        notes += [self.swapped] * bool(self.swapped) + self._facts
        if self.metadata.sequence_length != UNKNOWN_LENGTH and "sequence_length" not in self.unknown:
            return replace(self.metadata, extra=extra), notes + notes_on_lengths(self.frames, self.metadata)
        return replace(self.metadata, extra=extra, sequence_length=max(self.frames) - 1), notes


def _short(name: str, value: Any) -> str:
    """A value of the metadata as text, its numbers with four digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text}" for key, text in value.items())
    if name == "boundary" and len(set(value)) == 1:
        return str(value[0])
    if name in ("bounds", "domain"):
        return ", ".join(f"{axis} {span(ends)}" for axis, ends in zip("xyz", value, strict=False))
    if isinstance(value, frozenset | tuple):
        return ", ".join(_short("", each) for each in value)
    return "is not known" if value is None else str(value)


def renumber_types(source: ForeignDataset, ids: Mapping[int, int]) -> ForeignDataset:
    """The same dataset with new particle type ids by old ones; other ids stay, names and static types follow.

    Raises:
        ConfigError: if two types would get the same id, or an old id is unknown.
    """
    metadata = source.metadata
    unknown = sorted(set(ids) - set(metadata.particle_types))
    if unknown and "particle_types" not in source.unknown:
        names = ", ".join(f"{i} {name}" for i, name in sorted(metadata.particle_types.items()))
        raise ConfigError(f"There is no particle type {', '.join(map(str, unknown))}; known: {names}.")
    # A type whose id is requested for another and that is not renumbered itself is dropped; it must not occur.
    dropped = frozenset(ids.values()) - frozenset(ids)
    kept = {i: name for i, name in metadata.particle_types.items() if i not in dropped}
    types = {ids.get(i, i): name for i, name in kept.items()}
    if len(types) < len(kept) or len(set(ids.values())) < len(ids):
        raise ConfigError(f"{dict(ids)} gives two particle types the same id.")
    static = frozenset(ids.get(i, i) for i in metadata.static_types if i not in dropped)
    prescribed = frozenset(ids.get(i, i) for i in metadata.prescribed_types if i not in dropped)

    def renumber(trajectory: Trajectory) -> Trajectory:
        old = trajectory.particle_type
        if occurring := sorted(dropped.intersection(np.unique(old).tolist())):
            raise ConfigError(
                f"Particle type {occurring[0]} occurs, but its id is given to another type; give it a new one."
            )
        new = old.copy()
        for before, after in ids.items():
            new[old == before] = after
        return replace(trajectory, particle_type=new)

    renumbered = replace(metadata, particle_types=types, static_types=static, prescribed_types=prescribed)
    return source.map(renumber, renumbered)


@dataclass(frozen=True)
class Exported:
    """What an export wrote: a file to open, or a folder of so many of them, and notes for the user."""

    path: Path
    files: int
    notes: tuple[str, ...]

    @classmethod
    def of(cls, path: Path, files: int, left_out: set[str]) -> Exported:
        names = ", ".join(sorted(left_out))
        note = f"Not numbers of particles, so left out: {names}; .npz and .h5 hold all fields."
        return cls(path, files, (note,) if left_out else ())


def export(dataset: ForeignDataset, destination: Path, split: str | None, index: int | None) -> Exported:
    """Writes one trajectory to a file, or all into a folder with the file's name but its suffix.

    Args:
        dataset: With all facts.
        destination: Its suffix states the form.
        split: All splits when left out; with an index, the tests or else the first.
        index: Of the trajectory; all when left out.

    Raises:
        ConfigError: if there is no such form, split or trajectory.
        DataError: if a trajectory cannot be read, or the folder exists.
    """
    writer, splits = find_writer("DESTINATION", destination), list(dataset.splits)
    if split is not None and split not in splits:
        raise ConfigError(f"--split {split}: the dataset has {', '.join(splits)}.")
    if split is None and index is not None:
        split = "test" if "test" in splits else splits[0]
    chosen = splits if split is None else [split]
    counts = {name: dataset.counts[name] for name in chosen}
    total = sum(counts.values())
    if index is not None or total == 1:
        index, name = index or 0, chosen[0]
        if index >= counts[name]:
            raise ConfigError(f"--trajectory {index}: the {name} split has trajectories 0 … {counts[name] - 1}.")
        trajectory = next(islice(dataset.splits[name](), index, None))
        file = write_trajectory(destination, trajectory, dataset.metadata)
        return Exported.of(file, 1, writer.left_out(trajectory))
    folder, left_out = destination.with_suffix(""), set[str]()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(
            f"{folder}: exists already; {total} trajectories would become files in it. Choose another name, or one"
            " trajectory by --trajectory N."
        )
    with new_folder(folder) as new, progress_bar("Writing", total) as step:
        for name in counts:
            (new / name).mkdir()
            for index, trajectory in enumerate(dataset.splits[name]()):
                writer.write(new / name / f"{index:05d}{destination.suffix}", Clip(trajectory, dataset.metadata))
                left_out |= writer.left_out(trajectory)
                step()
    return Exported.of(folder, total, left_out)
