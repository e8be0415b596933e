"""The interface of format readers: a reader is one subclass of `DatasetFormat` in one file, listed in `FORMATS`."""

from __future__ import annotations

import abc
import copy
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Self, get_args

from nmpm._support.messages import one_line, suggestion
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.metadata import STATIC_NAMES
from nmpm.data.split_files import OTHER_NAMES, SPLITS, is_no_data
from nmpm.errors import ConfigError, DataError, NmpmError
from nmpm.scene import Boundary, Interval, check_field_names

UNKNOWN_LENGTH = 0
"""`Metadata.sequence_length` where the files do not state it; the conversion sets the length that it finds."""

ANY_NAME = ("*",)
"""Patterns of a reader that goes by the content of files."""

AXES = "axes"
"""Key of `metadata.json`: the order of the axes of positions, where a user states it."""
_SETTLED = ("bounds", "dt", "gravity", "boundary")


@dataclass(frozen=True)
class Options:
    """Facts that a user states where the files are silent or wrong; None takes what the files state.

    Raises:
        ConfigError: for another boundary, or a name that no field can have.
    """

    family: str | None = None  # meaning of the type ids: "deepmind", "lagrangebench", "jax-sph"
    types: Mapping[int, str] | None = None  # names of type ids; they override those of the family and the files
    static: frozenset[int] | None = None  # type ids that do not move
    prescribed: frozenset[int] | None = None  # type ids of obstacles that move as recorded, such as a paddle
    bounds: Sequence[Interval] | None = None  # where particles may be, (lower, upper) per axis, in domain length
    dt: float | None = None  # time between stored frames, in seconds
    gravity: Sequence[float] | None = None  # acceleration in length/s² per axis
    boundary: Sequence[Boundary] | None = None  # "wall", "periodic" or "open" per axis
    axes: str | None = None  # "TND" states that positions are frames, particles, axes, though they look swapped
    fields: Sequence[str] | None = None  # names of the fields that are inputs of models
    resample: float | None = None  # time between frames that positions are interpolated to
    smooth: int | None = None  # frames of the local quadratic fit that replaces positions
    files: str | None = None  # patterns of the names of the files to read, such as "Part{Fluid,Bound}_*"

    def __post_init__(self) -> None:
        if self.boundary is not None and not set(self.boundary) <= set(get_args(Boundary)):
            raise ConfigError(f"boundary = {list(self.boundary)} must be {', '.join(get_args(Boundary))} per axis.")
        if self.axes not in (None, "TND"):
            raise ConfigError(f"axes = {self.axes}: positions are read as TND: frames, particles, axes. Swap others.")
        check_field_names(self.fields or ())
        if self.resample is not None and not 0 < self.resample < math.inf:
            raise ConfigError(f"resample = {self.resample} must be positive: the time between the new frames.")
        if self.smooth is not None and (self.smooth < 5 or self.smooth % 2 == 0):
            raise ConfigError(f"smooth = {self.smooth} must be an odd number of frames, 5 or more.")

    @property
    def changes_positions(self) -> bool:
        """Whether files in the native layout cannot be used as they are."""
        return self.resample is not None or self.smooth is not None

    @property
    def of_converted(self) -> Options:
        """The same for data that are resampled and smoothed already."""
        return replace(self, dt=self.resample or self.dt, resample=None, smooth=None, files=None)

    @property
    def stated(self) -> frozenset[str]:
        """Fields of the metadata that these facts settle; names of types may be of some types only."""
        given = {"static_types": self.static, **{name: getattr(self, name) for name in _SETTLED}}
        return frozenset(name for name, value in given.items() if value is not None)

    def apply_to(self, metadata: Metadata) -> Metadata:
        """The metadata with the user's corrections; the family is applied where the type ids are read.

        Raises:
            ConfigError: if a value does not match the number of axes, or is invalid.
        """
        for name in ("bounds", "gravity", "boundary"):
            value = getattr(self, name)
            if value is not None and len(value) != metadata.dim:
                raise ConfigError(f"{name} = {list(value)} needs one entry for each of the data's {metadata.dim} axes.")
        if self.dt is not None and not self.dt > 0:
            raise ConfigError(f"dt = {self.dt} must be positive: seconds between stored frames.")
        if self.static and self.prescribed and self.static & self.prescribed:
            raise ConfigError(
                f"static = {sorted(self.static)} and prescribed = {sorted(self.prescribed)} share types: those"
                " that move as recorded are prescribed only."
            )
        if self.types:
            walls = frozenset(i for i, name in self.types.items() if name in STATIC_NAMES)
            static = (metadata.static_types - frozenset(self.types)) | walls
            prescribed = metadata.prescribed_types - frozenset(self.types)
            names = metadata.particle_types | dict(self.types)
            metadata = replace(metadata, particle_types=names, static_types=static, prescribed_types=prescribed)
        if self.static:
            metadata = replace(metadata, prescribed_types=metadata.prescribed_types - self.static)
        changes: dict[str, Any] = {"static_types": self.static, "prescribed_types": self.prescribed}
        changes["dt"] = self.resample or self.dt
        changes["extra"] = metadata.extra | {AXES: self.axes} if self.axes else None
        if self.bounds is not None:
            changes |= {"bounds": tuple((float(low), float(high)) for low, high in self.bounds)}
            metadata = replace(metadata, domain=None)
        if self.gravity is not None:
            changes["gravity"] = tuple(map(float, self.gravity))
        if self.boundary is not None:
            changes["boundary"] = tuple(self.boundary)
        if self.fields is not None:
            changes["fields"] = tuple(self.fields)
        return replace(metadata, **{name: value for name, value in changes.items() if value is not None})


def make_options(facts: Mapping[str, Any]) -> Options:
    """The options of these names; raises a ConfigError for a name that is none of them."""
    names = [field.name for field in fields(Options)]
    unknown = next((name for name in facts if name not in names), None)
    if unknown is not None:
        raise ConfigError(f"{unknown} is no fact; known: {', '.join(names)}.{suggestion(unknown, names)}")
    sets = {name: frozenset(value) for name, value in facts.items() if name in ("static", "prescribed") and value}
    return Options(**{**facts, **sets})


@dataclass(frozen=True)
class ForeignDataset:
    """An opened dataset of another format."""

    metadata: Metadata
    splits: Mapping[str, Callable[[], Iterator[Trajectory]]]  # of "train", "valid", "test": starts to read trajectories
    notes: tuple[str, ...] = ()  # for the user, on assumptions and inconsistencies
    counts: Mapping[str, int | None] = field(default_factory=dict)  # None where only reading all would tell
    assumed: frozenset[str] = frozenset()  # fields of the metadata that the files do not state
    unknown: frozenset[str] = frozenset()  # fields of the metadata that are to be found in the trajectories
    steps: bool = False  # whether times are numbers of a simulator's steps, of a length that the files do not state
    whole: ForeignDataset | None = None  # the same without cuts, where runs were cut along time into splits


class DatasetFormat(abc.ABC):
    """Abstract reader of a format, one subclass per format.

    Attributes:
        name: The format's name.
        summary: One line for the command line's help.
        patterns: Of the files' names; none where names are fixed.
        selected: Further patterns, which the user states.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    patterns: tuple[str, ...] = ()
    selected: tuple[str, ...] = ()

    def select(self, files: str) -> Self:
        """The same reader of those files alone whose names fit one of these patterns, separated by commas."""
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


class FileFormat(DatasetFormat):
    """Abstract reader of a format whose trajectories lie in files of one kind, one subclass per format.

    The files of the splits are in folders called train, valid and test, or have names that begin so; other files, and a
    file alone, are the test split.

    Attributes:
        pattern: Of the files' names.
        family: Meaning of the type ids where the user names no family.
        assumed: Fields of the metadata that the files do not state.
    """

    pattern: ClassVar[str]
    family: ClassVar[str] = "deepmind"
    assumed: ClassVar[frozenset[str]] = frozenset()

    @abc.abstractmethod
    def metadata(self, file: Path, options: Options) -> tuple[Metadata, tuple[str, ...]]:
        """Facts about the dataset from its first file, before the user's corrections, and notes for the user."""

    @abc.abstractmethod
    def read(self, file: Path, metadata: Metadata, options: Options) -> Iterator[Trajectory]:
        """Yields the trajectories of a file; raises a DataError that names it if it is damaged."""

    def count(self, file: Path) -> int | None:  # noqa: ARG002 (for subclasses)
        """Number of trajectories in a file; None where only reading them all would tell."""
        return 1

    def recognises(self, path: Path) -> bool:
        return bool(split_files(path, self.pattern))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        files = split_files(path, self.pattern)
        if not files:
            raise DataError(f"{path}: no file {self.pattern} there.")
        stated, notes = self.metadata(next(iter(files.values()))[0], options)
        metadata = options.apply_to(stated)
        counts = {split: [self.count(file) for file in paths] for split, paths in files.items()}
        renamed = (
            f"{paths[0].name} becomes the {split} split."
            for split, paths in files.items()
            if len(paths) == 1 and split not in (paths[0].stem, paths[0].parent.name)
        )
        return ForeignDataset(
            metadata,
            {split: partial(self._read_all, paths, metadata, options) for split, paths in files.items()},
            (f"Particle types have the meaning of the {options.family or self.family} family.", *notes, *renamed),
            {split: None if None in each else sum(number or 0 for number in each) for split, each in counts.items()},
            self.assumed,
        )

    def _read_all(self, files: tuple[Path, ...], metadata: Metadata, options: Options) -> Iterator[Trajectory]:
        for file in files:
            yield from self.read(file, metadata, options)


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


def split_files(path: Path, *patterns: str, unsplit: str = "test") -> dict[str, tuple[Path, ...]]:
    """The files of each split, ordered by the numbers in their names; see `FileFormat`.

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
    lower = [word.lower() for word in words]
    return next((split for split in SPLITS if {split, *OTHER_NAMES[split]} & set(lower)), None)


def split_runs(count: int) -> dict[str, range]:
    """Splits runs that nobody has split: the last tenth (at least one) for tests, the tenth before to validate.

    One or two runs are all for training.
    """
    tenth = max(1, count // 10) if count > 2 else 0
    parts = {
        "train": range(count - 2 * tenth),
        "valid": range(count - 2 * tenth, count - tenth),
        "test": range(count - tenth, count),
    }
    return {split: part for split, part in parts.items() if part}
