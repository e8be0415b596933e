"""Readers of files that hold one run or several, which may be divided into splits or not."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.convert.base import (
    UNKNOWN_LENGTH,
    DatasetFormat,
    ForeignDataset,
    Options,
    is_selected,
    split_files,
    split_runs,
)
from nmpm.data.format import ID, Metadata, Trajectory
from nmpm.data.metadata import find_family
from nmpm.data.split_files import SPLITS
from nmpm.errors import DataError

LEAST_FRAMES = 16
"""Frames of the parts for validation and tests when one or two runs are cut along time."""

EVERYTHING_UNKNOWN = frozenset(
    {"bounds", "dt", "gravity", "static_types", "boundary", "particle_volume", "sequence_length", "particle_types"}
)

Facts = tuple[Metadata, frozenset[str], tuple[str, ...]]
"""Metadata, names of its fields that are unknown, and notes for the user."""


def placeholder_metadata(dim: int, **facts: Any) -> Metadata:
    """Metadata with these facts, and placeholders for all others."""
    values: dict[str, Any] = {"bounds": ((0.0, 1.0),) * dim, "dt": 1.0, "particle_types": {}}
    return Metadata(dim=dim, sequence_length=UNKNOWN_LENGTH, **(values | facts))


@dataclass(frozen=True)
class Run:
    """A run in a file."""

    file: Path
    index: int  # which of the file's runs it is
    frames: int = 0  # 0 where they are not counted
    split: str | None = None  # where names in the file state one
    part: range | None = None  # frames to take; None for all

    def take(self, trajectory: Trajectory) -> Trajectory:
        """The part of its whole trajectory."""
        return trajectory if self.part is None else cut(trajectory, self.part)


_CUT = "Cut along time: the first 80% of the frames train, then 10% valid, 10% test."

SomeRun = TypeVar("SomeRun", bound=Run)


class RunFiles(DatasetFormat):
    """Abstract reader of a format whose files hold one run or several each, one subclass per format.

    Files are divided into splits as for `FileFormat`, or runs by their names. Where nothing divides them, the last
    tenths of the runs test and validate (`split_runs`); one or two long runs are cut along time, 80:10:10.
    """

    def recognises(self, path: Path) -> bool:
        return bool(self.files(path))

    def runs(self, file: Path) -> Sequence[Run]:
        """The runs in a file, in order; one where a subclass does not say it."""
        return [Run(file, 0)]

    def frames(self, run: Run) -> int:
        """Number of frames of a run, which `runs` need not count."""
        return run.frames

    @abc.abstractmethod
    def facts(self, file: Path) -> Facts:
        """What the first file states."""

    @abc.abstractmethod
    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        """Yields some of the runs of a file, in ascending order."""

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        """The files of each split; those that nothing divides are "all"."""
        files = split_files(path, *self.patterns, unsplit="all")
        kept = {
            split: tuple(file for file in inside if is_selected(file, self.selected)) for split, inside in files.items()
        }
        return {split: inside for split, inside in kept.items() if inside}

    def open(self, path: Path, options: Options) -> ForeignDataset:
        files = self.files(path)
        if not files:
            raise DataError(f"{path}: no file {' or '.join(self.patterns)} there.")
        runs = {split: [run for file in paths for run in self.runs(file)] for split, paths in files.items()}
        if len(runs.get("all", ())) in (1, 2):  # they may be cut along time
            runs["all"] = [replace(run, frames=self.frames(run)) for run in runs["all"]]
        facts = self.facts(next(iter(files.values()))[0])
        return open_divided(runs, facts, self._read_all, options)

    def _read_all(self, runs: Sequence[Run], metadata: Metadata) -> Iterator[Trajectory]:
        for file in dict.fromkeys(run.file for run in runs):
            inside = [run for run in runs if run.file == file]
            trajectories = self.read(file, [run.index for run in inside], metadata)
            for run, trajectory in zip(inside, trajectories, strict=True):
                yield run.take(trajectory)


def open_divided(
    runs: Mapping[str, Sequence[SomeRun]],
    facts: Facts,
    read: Callable[[Sequence[SomeRun], Metadata], Iterator[Trajectory]],
    options: Options,
) -> ForeignDataset:
    """The dataset of runs by split, of which those of the split "all" are divided by `divide`.

    `read` gets metadata with the names of types that are in the files, also where the user gives other names.
    """
    stated, unknown, notes = facts
    metadata = stated
    if options.family is not None:
        family = find_family(options.family)
        names, static, prescribed = dict(family.types), family.static, family.prescribed
        metadata = replace(metadata, particle_types=names, static_types=static, prescribed_types=prescribed)
        unknown -= {"particle_types", "static_types"}
    metadata, undivided = options.apply_to(metadata), runs.get("all")
    splits, divided = divide(undivided) if undivided else (runs, ())
    in_files = replace(metadata, particle_types={**metadata.particle_types, **stated.particle_types})

    def dataset(splits: Mapping[str, Sequence[SomeRun]], notes: tuple[str, ...]) -> ForeignDataset:
        readers = {split: partial(read, each, in_files) for split, each in splits.items()}
        counts = {split: len(each) for split, each in splits.items()}
        return ForeignDataset(metadata, readers, notes, counts, unknown=unknown - options.stated)

    whole = dataset({"train": undivided}, notes) if undivided and divided == (_CUT,) else None
    return replace(dataset(splits, (*notes, *divided)), whole=whole)


def divide(runs: Sequence[SomeRun]) -> tuple[dict[str, Sequence[SomeRun]], tuple[str, ...]]:
    """Runs that no folder divides, by split; and notes on how they were divided."""
    named = {split: [run for run in runs if run.split == split] for split in SPLITS}
    if any(named.values()):
        rest = [run for run in runs if run.split is None]
        left_out = (f"{counted(len(rest), 'run')} in no split left out.",) if rest else ()
        return {split: parts for split, parts in named.items() if parts}, left_out
    if len(runs) > 2:
        parts = split_runs(len(runs))
        sizes = ", ".join(f"{len(part)} {split}" for split, part in parts.items())
        note = f"Nothing divides the {len(runs)} runs: in their order {sizes}. Folders train, valid, test would."
        return {split: [runs[index] for index in part] for split, part in parts.items()}, (note,)
    if all(run.frames >= 10 * LEAST_FRAMES for run in runs):
        return {split: [replace(run, part=split_runs(run.frames)[split]) for run in runs] for split in SPLITS}, (_CUT,)
    return {"train": runs}, (f"{counted(len(runs), 'run')}, too few to divide: all for training.",)


def cut(trajectory: Trajectory, part: range) -> Trajectory:
    """Some consecutive frames of a trajectory, without particles that are in none of them."""
    frames, particles = trajectory.position.shape[:2]
    position = trajectory.position[part.start : part.stop]
    keep = ~np.isnan(position[..., 0]).all(axis=0)
    if len(part) == frames and (keep.all() or not keep.any()):
        return trajectory

    def cut_field(name: str, values: np.ndarray) -> np.ndarray:
        if values.shape[:1] == (frames,) and not (name == ID and values.shape == (particles,)):
            values = values[part.start : part.stop]
            return values[:, keep] if values.shape[1:2] == (particles,) else values
        return values[keep] if values.shape[:1] == (particles,) else values

    fields = {name: cut_field(name, values) for name, values in trajectory.fields.items()}
    return Trajectory(position[:, keep], trajectory.particle_type[keep], trajectory.attributes, fields)
