"""The interface of format readers: a reader is one subclass of `DatasetFormat` in one file, listed in `FORMATS`."""

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
"""`Metadata.sequence_length` where the files do not state it; the conversion sets the length that it finds."""


@dataclass(frozen=True)
class Options:
    """Facts that a user states where the files are silent or wrong; None takes what the files state.

    Args:
        family: Meaning of the type ids: "deepmind", "lagrangebench", "jax-sph".
        types: Names of type ids; they override those of the family and the files.
        static: Type ids that do not move.
        bounds: Where particles may be, (lower, upper) per axis, in domain length.
        dt: Time between stored frames, in seconds.
        gravity: Acceleration in length/s² per axis.
        periodic: Whether each axis is periodic.
        fields: Names of the fields that are inputs of models.
    """

    family: str | None = None
    types: Mapping[int, str] | None = None
    static: frozenset[int] | None = None
    bounds: tuple[Interval, ...] | None = None
    dt: float | None = None
    gravity: tuple[float, ...] | None = None
    periodic: tuple[bool, ...] | None = None
    fields: tuple[str, ...] | None = None

    def apply_to(self, metadata: Metadata) -> Metadata:
        """The metadata with the user's corrections; the family is applied where the type ids are read.

        Raises:
            ConfigError: if a value does not match the number of axes, or is invalid.
        """
        for name in ("bounds", "gravity", "periodic"):
            value = getattr(self, name)
            if value is not None and len(value) != metadata.dim:
                raise ConfigError(f"{name} = {value} needs one entry for each of the data's {metadata.dim} axes.")
        if self.dt is not None and not self.dt > 0:
            raise ConfigError(f"dt = {self.dt} must be positive: seconds between stored frames.")
        if self.bounds is not None:
            metadata = replace(metadata, domain=None, bounds=self.bounds)
        if self.types:
            walls = frozenset(i for i, name in self.types.items() if name in STATIC_NAMES)
            static = (metadata.static_types - frozenset(self.types)) | walls
            metadata = replace(metadata, particle_types=metadata.particle_types | dict(self.types), static_types=static)
        changes: dict[str, Any] = {"static_types": self.static}
        changes |= {name: getattr(self, name) for name in ("dt", "gravity", "periodic", "fields")}
        return replace(metadata, **{name: value for name, value in changes.items() if value is not None})


@dataclass(frozen=True)
class Rereadable(Iterable[Trajectory]):
    """Trajectories that are read again in each iteration.

    Args:
        start: Starts a new iteration.
    """

    start: Callable[[], Iterator[Trajectory]]

    def __iter__(self) -> Iterator[Trajectory]:
        return self.start()


@dataclass(frozen=True)
class ForeignDataset:
    """An opened dataset of another format.

    Args:
        metadata: Facts that all trajectories share.
        splits: Trajectories of the splits "train", "valid" and "test" that exist; read one by one, in each iteration.
        notes: Sentences for the user, on assumptions and inconsistencies.
        counts: Trajectories per split; None where only reading them all would tell.
        assumed: Fields of the metadata that the files do not state.
    """

    metadata: Metadata
    splits: Mapping[str, Iterable[Trajectory]]
    notes: tuple[str, ...] = ()
    counts: Mapping[str, int | None] = field(default_factory=dict)
    assumed: frozenset[str] = frozenset()


class DatasetFormat(abc.ABC):
    """Abstract reader of a format, one subclass per format."""

    name: ClassVar[str]
    """The format's name."""

    summary: ClassVar[str]
    """One line for the command line's help."""

    @abc.abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether a file or folder looks like this format; cheap, raises nothing."""

    @abc.abstractmethod
    def open(self, path: Path, options: Options) -> ForeignDataset:
        """Opens a dataset of this format.

        Raises:
            DataError: if a file is missing, damaged or not of this format; names the file.
        """


def split_name(stem: str) -> str | None:
    """The split that a file's name begins with, or None: "test_sub" means test."""
    return next((split for split in SPLITS if stem.lower().startswith(split)), None)


def family_note(family: str) -> str:
    """The note that says how type ids are read."""
    return f"Particle types have the meaning of the {family} family."
