"""Datasets in Python: trajectories by split, read when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

from nmpm.data.convert.base import make_options
from nmpm.data.format import Metadata, Split, Trajectory
from nmpm.data.loading.sources import FolderSource
from nmpm.data.split_files import find_split, split_paths
from nmpm.errors import DataError
from nmpm.scene import Scene


def load_trajectories(path: str | Path, **facts: Any) -> Dataset:
    """Opens a dataset of any format that `nmpm convert` reads.

    Files that are not in the native layout are converted into the cache on the first access.

        data = nmpm.load_trajectories("grains.npz", dt=0.004)
        data.train[3].position  # (T, N, D)
        data.scene

    Args:
        path: A file or folder.
        facts: What the files do not state, such as `dt` or `gravity`: the fields of `nmpm.data.convert.Options`.

    Raises:
        DataError: if there is no such file or folder.
        ConfigError: if there is no such fact, or its value is invalid.
    """
    if not Path(path).exists():
        raise DataError(f"{path}: no such file or folder.")
    return Dataset(FolderSource(Path(path), make_options(facts)))


class Trajectories(Sequence[Trajectory]):
    """The trajectories of a split, read from the file at each access, with their fields and metadata."""

    def __init__(self, split: Split, metadata: Metadata) -> None:
        self._split, self._metadata = split, metadata

    def __len__(self) -> int:
        return len(self._split)

    def __repr__(self) -> str:
        return f"<{len(self)} trajectories of {self._split.path}>"

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory]: ...
    def __getitem__(self, index: int | slice) -> Trajectory | list[Trajectory]:
        numbers = range(len(self))[index]
        if isinstance(numbers, range):
            return [self[number] for number in numbers]
        return replace(self._split.read_with_fields(numbers), metadata=self._metadata)


@dataclass(frozen=True)
class Dataset:
    """A dataset of recorded trajectories, as `load_trajectories` gives it."""

    source: FolderSource

    def __repr__(self) -> str:
        sizes = ", ".join(f"{len(part)} {name}" for name, part in self.splits.items())
        return f"<{self.source.description}: {sizes}>"

    @property
    def folder(self) -> Path:
        """The folder in the native layout, in the cache for other formats."""
        return self.source.folder

    @property
    def metadata(self) -> Metadata:
        """Facts that all trajectories share."""
        return self.source.metadata

    @property
    def scene(self) -> Scene:
        """The scene that a model would be trained for."""
        return self.source.scene

    @cached_property
    def splits(self) -> Mapping[str, Trajectories]:
        """The splits that there are, by name."""
        return {name: Trajectories(Split(path), self.metadata) for name, path in split_paths(self.folder).items()}

    @property
    def train(self) -> Trajectories:
        """Trajectories for training; a DataError if there are none."""
        return self._split("train")

    @property
    def valid(self) -> Trajectories:
        """Trajectories for validations; a DataError if there are none."""
        return self._split("valid")

    @property
    def test(self) -> Trajectories:
        """Trajectories for tests; a DataError if there are none."""
        return self._split("test")

    def _split(self, name: str) -> Trajectories:
        return self.splits[find_split(self.folder, name).stem]
