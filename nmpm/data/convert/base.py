"""What every reader of a foreign format gives, and what it may be told."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from nmpm.data.families import STATIC_NAMES
from nmpm.data.format import SPLITS, Metadata, Trajectory
from nmpm.errors import ConfigError
from nmpm.scene import Interval

UNKNOWN_LENGTH = 0
"""For `Metadata.sequence_length`, where the files leave it open: conversion puts in what it finds."""


@dataclass(frozen=True)
class Options:
    """What a user says where files leave it open or are wrong; None leaves it to the files.

    Args:
        family: What type ids mean: "deepmind", "lagrangebench", "jax-sph".
        types: Names of type ids, beside or instead of those of the family and the files.
        static: Type ids that never move.
        bounds: Where particles may be, (lower, upper) per axis, in domain length.
        dt: Time between stored frames, in seconds.
        gravity: Acceleration in length/s² per axis.
        periodic: Whether each axis wraps.
    """

    family: str | None = None
    types: Mapping[int, str] | None = None
    static: frozenset[int] | None = None
    bounds: tuple[Interval, ...] | None = None
    dt: float | None = None
    gravity: tuple[float, ...] | None = None
    periodic: tuple[bool, ...] | None = None

    def apply_to(self, metadata: Metadata) -> Metadata:
        """The metadata as the user corrects them; the family is left to whoever reads the type ids.

        Raises:
            ConfigError: if a value does not fit the number of axes, or cannot be.
        """
        for name in ("bounds", "gravity", "periodic"):
            value = getattr(self, name)
            if value is not None and len(value) != metadata.dim:
                raise ConfigError(f"{name} = {value} needs one entry for each of the data's {metadata.dim} axes.")
        if self.dt is not None and not self.dt > 0:
            raise ConfigError(f"dt = {self.dt} must be positive: the seconds between stored frames.")
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("dt", "gravity", "periodic", "static")}
        changes["static_types"] = changes.pop("static")
        if self.bounds is not None:
            metadata = replace(metadata, domain=None, bounds=self.bounds)
        if self.types:
            walls = frozenset(i for i, name in self.types.items() if name in STATIC_NAMES)
            static = (metadata.static_types - frozenset(self.types)) | walls
            metadata = replace(metadata, particle_types=metadata.particle_types | dict(self.types), static_types=static)
        return replace(metadata, **{name: value for name, value in changes.items() if value is not None})


@dataclass(frozen=True)
class Rereadable(Iterable[Trajectory]):
    """Trajectories read anew each time they are iterated over.

    Args:
        start: Begins a new reading.
    """

    start: Callable[[], Iterator[Trajectory]]

    def __iter__(self) -> Iterator[Trajectory]:
        return self.start()


def split_name(stem: str) -> str | None:
    """The split that a file's name begins with: "test_sub" means test."""
    return next((split for split in SPLITS if stem.lower().startswith(split)), None)


@dataclass(frozen=True)
class ForeignDataset:
    """A foreign dataset, opened.

    Args:
        metadata: What holds for every trajectory.
        splits: Trajectories of "train", "valid" and "test", as far as there are any; read one by one, each time anew.
        notes: Sentences for the user: what was taken for what, and what is odd.
        counts: Trajectories per split, where known without reading them all.
    """

    metadata: Metadata
    splits: Mapping[str, Iterable[Trajectory]]
    notes: tuple[str, ...] = ()
    counts: Mapping[str, int | None] = field(default_factory=dict)


class DatasetFormat(abc.ABC):
    """A foreign format; below it, one class per format."""

    name: ClassVar[str]
    """By which it can be asked for."""

    summary: ClassVar[str]
    """One line for the help."""

    @abc.abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether a file or folder looks like this format; cheap, and never raises."""

    @abc.abstractmethod
    def open(self, path: Path, options: Options) -> ForeignDataset:
        """A dataset of this format.

        Raises:
            DataError: if a file is missing, damaged or not of this format; names it.
        """
