"""The interface of readers: a reader is a subclass of `RunFiles`, or of `frame_files.FrameFormat`, listed in `READERS`.

data/train/0.npz, data/valid/0.npz      splits by folders, also "val", "training", …
data/train_0.npz, data/test.npz         or by names of files
data/0.npz, data/1.npz                  or by nothing: the last tenths of the runs validate and test
"""

from __future__ import annotations

import abc
import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Self

import numpy as np

from nmpm._support.bounded_files import check_regular
from nmpm._support.messages import counted, install, one_line
from nmpm.data.families import find_family
from nmpm.data.format import ID, OTHER_NAMES, SPLITS, Metadata, Trajectory, is_no_data
from nmpm.data.stated import Options as Options
from nmpm.errors import ConfigError, DataError, NmpmError

UNKNOWN_LENGTH = 0
"""`Metadata.sequence_length` where the files do not state it; the conversion sets the length that it finds."""

ANY_NAME = ("*",)
"""Patterns of a reader that goes by the content of files."""

LEAST_FRAMES = 16
"""Frames of the parts for validation and tests when one or two runs are cut along time."""
EVERYTHING_UNKNOWN = frozenset(
    {"bounds", "dt", "gravity", "static_types", "boundary", "particle_volume", "sequence_length", "particle_types"}
)
_CUT = "Cut along time: the first 80% of the frames train, then 10% valid, 10% test."


@dataclass(frozen=True)
class Facts:
    """Facts that the files of a dataset state."""

    metadata: Metadata  # with placeholders for what is unknown
    unknown: frozenset[str] = frozenset()  # fields of the metadata that are to be found in the trajectories
    notes: tuple[str, ...] = ()  # for the user, on assumptions and inconsistencies
    assumed: frozenset[str] = frozenset()  # fields of the metadata that the files do not state
    steps: bool = False  # whether times are numbers of a simulator's steps, of a length that the files do not state
    has_family: bool = False  # whether the types are named by the family that the user states, where he does


@dataclass(frozen=True)
class ForeignDataset:
    """An opened dataset of another format: its `Facts`, as the user corrects them, and its trajectories."""

    metadata: Metadata
    splits: Mapping[str, Callable[[], Iterator[Trajectory]]]  # of "train", "valid", "test": starts to read trajectories
    notes: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)  # trajectories of the splits, as far as they are counted
    assumed: frozenset[str] = frozenset()
    unknown: frozenset[str] = frozenset()
    steps: bool = False
    whole: ForeignDataset | None = None  # the same without cuts, where runs were cut along time into splits

    def map(self, change: Callable[[Trajectory], Trajectory], metadata: Metadata | None = None) -> ForeignDataset:
        """The dataset with each trajectory changed as it is read, and perhaps other metadata."""

        def changed(start: Callable[[], Iterator[Trajectory]]) -> Iterator[Trajectory]:
            return map(change, start())

        splits = {name: partial(changed, start) for name, start in self.splits.items()}
        return replace(self, splits=splits, metadata=metadata or self.metadata)


def placeholder_metadata(dim: int, **facts: Any) -> Metadata:
    """Metadata with these facts, and placeholders for all others."""
    values: dict[str, Any] = {"bounds": ((0.0, 1.0),) * dim, "dt": 1.0, "particle_types": {}}
    return Metadata(dim=dim, sequence_length=UNKNOWN_LENGTH, **(values | facts))


class Reader(abc.ABC):
    """Abstract reader of a format, one subclass per format.

    Attributes:
        summary: One line for the command line's help.
        patterns: Of the files' names.
        fixed_names: Whether files of other names are never of the format, whatever the user states.
        selected: Further patterns, which the user states.
        signature: Bytes that files begin with, by which they are recognised where their names have no usual suffix.
    """

    summary: ClassVar[str]
    patterns: tuple[str, ...] = ()
    fixed_names: ClassVar[bool] = False
    selected: tuple[str, ...] = ()
    signature: ClassVar[bytes] = b""

    def select(self, files: str) -> Self:
        """The same reader of those files alone whose names fit one of these patterns, separated by commas.

        Raises:
            ConfigError: if the format has fixed names.
        """
        if self.fixed_names:
            raise ConfigError(f"--files {files}: the names of files of this format are fixed. Leave it out.")
        selecting = copy.copy(self)
        selecting.selected = tuple(pattern.strip() for pattern in files.split(","))
        return selecting

    def with_any_name(self) -> Self:
        """The same reader of files with any names."""
        reader = copy.copy(self)
        reader.patterns = ANY_NAME
        return reader

    @abc.abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether a file or folder looks like this format; cheap, and errors mean no."""

    @abc.abstractmethod
    def open(self, path: Path, options: Options) -> ForeignDataset:
        """Opens a dataset; raises a DataError that names the file if it is missing, damaged or of another format."""


@dataclass(frozen=True)
class Run:
    """A run: one of those in a file, or a folder with a file per frame."""

    file: Path
    index: int  # which of the file's runs it is
    frames: int = 0  # 0 where a run must be read to count them
    split: str | None = None  # where names in the file state one
    part: range | None = None  # frames to take; None for all
    source: Any = None  # further knowledge of the reader, on where its frames are


class RunFiles(Reader):
    """Abstract reader of a format whose files hold one run or several each, one subclass per format.

    Attributes:
        family: Of formats that describe their scene: the meaning of type ids where the user names none. Files that
            nothing divides are tests then.
    """

    family: ClassVar[str] = ""

    def recognises(self, path: Path) -> bool:
        return bool(self.files(path))

    def runs(self, file: Path) -> Sequence[Run]:
        """The runs in a file, in order; one where a subclass does not say it."""
        return [Run(file, 0)]

    @abc.abstractmethod
    def facts(self, file: Path, options: Options) -> Facts:
        """What the first file states; of the user's facts, those that are needed to read it are used."""

    @abc.abstractmethod
    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        """Yields some of the runs of a file, in ascending order; raises a DataError that names it if it is damaged."""

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        """The files of each split; those that nothing divides are "all", which `divide` divides, or tests."""
        files = split_files(path, *self.patterns, unsplit="test" if self.family else "all")
        kept = {
            split: tuple(file for file in inside if is_selected(file, self.selected)) for split, inside in files.items()
        }
        return {split: inside for split, inside in kept.items() if inside}

    def open(self, path: Path, options: Options) -> ForeignDataset:
        files = self.files(path)
        if not files:
            raise DataError(f"{path}: no file {' or '.join(self.patterns)} there.")
        runs = {split: [run for file in paths for run in self.runs(file)] for split, paths in files.items()}
        facts = self.facts(next(iter(files.values()))[0], options)
        if len(runs.get("all", ())) in (1, 2):  # they may be cut along time
            for number, run in enumerate(runs["all"]):
                if not run.frames:
                    with suppress(DataError):  # raised again where the run is needed
                        trajectories = self.read(run.file, [run.index], facts.metadata)
                        frames = sum(len(trajectory.position) for trajectory in trajectories)
                        runs["all"][number] = replace(run, frames=frames)
        if self.family:
            renamed = (
                f"{inside[0].name} becomes the {split} split."
                for split, inside in files.items()
                if len(inside) == 1 and split not in (inside[0].stem, inside[0].parent.name)
            )
            family = f"Particle types have the meaning of the {options.family or self.family} family."
            facts = replace(facts, notes=(family, *facts.notes, *renamed), has_family=True)
        return open_divided(runs, facts, self._read_all, options)

    def _read_all(self, runs: Sequence[Run], metadata: Metadata) -> Iterator[Trajectory]:
        for file, group in groupby(runs, lambda run: run.file):
            inside = list(group)
            trajectories = self.read(file, [run.index for run in inside], metadata)
            for run in inside:
                trajectory = next(trajectories, None)
                if trajectory is None:
                    raise DataError(f"{file}: its run {run.index} is missing, or empty.")
                yield trajectory if run.part is None else cut(trajectory, run.part)


def open_divided(
    runs: Mapping[str, Sequence[Run]],
    facts: Facts,
    read: Callable[[Sequence[Run], Metadata], Iterator[Trajectory]],
    options: Options,
) -> ForeignDataset:
    """The dataset of runs by split, of which those of the split "all" are divided by `divide`.

    `read` gets metadata with the names of types that are in the files, also where the user gives other names.
    """
    metadata, unknown = facts.metadata, facts.unknown - options.settled
    if options.family is not None and not facts.has_family:
        family = find_family(options.family)
        names, static, prescribed = dict(family.types), family.static, family.prescribed
        metadata = replace(metadata, particle_types=names, static_types=static, prescribed_types=prescribed)
        unknown -= {"particle_types", "static_types"}
    metadata, undivided = options.apply_to(metadata), runs.get("all")
    splits, divided = divide(undivided) if undivided else (runs, ())
    in_files = replace(metadata, particle_types={**metadata.particle_types, **facts.metadata.particle_types})

    def dataset(splits: Mapping[str, Sequence[Run]], notes: tuple[str, ...]) -> ForeignDataset:
        readers = {split: partial(read, each, in_files) for split, each in splits.items()}
        counts = {split: len(each) for split, each in splits.items()}
        return ForeignDataset(metadata, readers, notes, counts, facts.assumed, unknown, facts.steps)

    whole = dataset({"train": undivided}, facts.notes) if undivided and divided == (_CUT,) else None
    return replace(dataset(splits, (*facts.notes, *divided)), whole=whole)


def divide(runs: Sequence[Run]) -> tuple[dict[str, Sequence[Run]], tuple[str, ...]]:
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


def split_runs(count: int) -> dict[str, range]:
    """The last tenth (at least one) of more than two runs for tests, the tenth before to validate, others to train."""
    tenth = max(1, count // 10) if count > 2 else 0
    edges = (0, count - 2 * tenth, count - tenth, count)
    return {split: range(low, high) for split, low, high in zip(SPLITS, edges, edges[1:], strict=False) if low < high}


@contextmanager
def readable(where: Path | str, kind: str, *errors: type[Exception]) -> Iterator[None]:
    """Turns errors of a file, these and the usual ones, into a DataError: it cannot be read as `kind`."""
    kinds: tuple[type[Exception], ...] = (*errors, OSError, EOFError, ValueError, ArithmeticError, MemoryError)
    try:
        yield
    except NmpmError:
        raise
    except kinds as error:
        hint = "" if type(error) is ValueError else " Is it complete? Copy it again."
        reason = one_line(error) or type(error).__name__
        raise DataError(f"{where}: cannot be read as {kind} ({reason}).{hint}") from error


def needs(path: Path, kind: str, package: str, extra: str, module: str | None = None) -> None:
    """Checks that a path is a regular file, and that the package is installed that reads files of its kind.

    Raises:
        DataError: if there is no such file.
        ConfigError: if the package, whose module may have another name, is missing.
    """
    check_regular(path)
    if find_spec(module or package) is None:
        raise ConfigError(f"{path}: reading {kind} needs {package}: {install(extra)}.")


@contextmanager
def located(where: Path | str) -> Iterator[None]:
    """Puts a file or trajectory in front of the message of a DataError."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def is_selected(file: Path, patterns: Sequence[str]) -> bool:
    """Whether the end of a file's path fits one of the patterns, in lower or upper case; of none any does."""
    lower = PurePosixPath(file.as_posix().lower())
    return not patterns or any(lower.match(pattern.lower()) for pattern in patterns)


def split_files(path: Path, *patterns: str, unsplit: str) -> dict[str, tuple[Path, ...]]:
    """The files of each split, ordered by the numbers in their names; see the module.

    Names such as "val" mean a split too. Files that are in none are those of `unsplit`.
    """

    def split_of(name: str) -> str | None:
        words = re.findall(r"[a-z]+", name.lower())[:1]
        return next((split for split in SPLITS if name.lower().startswith(split)), None) or find_split_name(*words)

    def matching(folder: Path) -> list[Path]:
        files = (file for pattern in patterns for file in folder.glob(pattern))
        return list({file: None for file in files if not is_no_data(file.name)})

    if path.is_file():
        return {split_of(path.name) or unsplit: (path,)} if any(map(path.match, patterns)) else {}
    files = {
        split: [file for name in (split, *OTHER_NAMES[split]) for file in matching(path / name)] for split in SPLITS
    }
    if not any(files.values()):
        beside = matching(path)
        files = {split: [file for file in beside if split_of(file.name) == split] for split in SPLITS}
        if not any(files.values()):
            files = {split_of(path.name) or unsplit: beside}
    return {split: tuple(sorted(paths, key=number_order)) for split, paths in files.items() if paths}


def number_order(path: Path) -> tuple[list[int], str]:
    """Sorts files by the numbers in their names: 10 follows 9."""
    return [int(digits) for digits in re.findall(r"\d{1,18}", path.name)], path.name


def find_split_name(*words: str) -> str | None:
    """The split that one of some words means, such as "val" or "training"; None if none does."""
    lower = {word.lower() for word in words}
    return next((split for split in SPLITS if not lower.isdisjoint({split, *OTHER_NAMES[split]})), None)
