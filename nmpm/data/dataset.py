"""Datasets in Python: trajectories by split, read when they are asked for, and written from arrays in memory."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np

from nmpm.data.array_checks import check_end, swapped_axes
from nmpm.data.convert.conversion import write_native
from nmpm.data.convert.run_arrays import Runs, open_runs
from nmpm.data.format import (
    METADATA_FILE,
    SPLITS,
    Metadata,
    Split,
    Trajectory,
    find_split,
    read_metadata,
    split_paths,
    write_metadata,
    write_split,
)
from nmpm.data.metadata import scene_metadata
from nmpm.data.sources import FolderSource
from nmpm.data.stated import Options
from nmpm.data.statistics import first_outside
from nmpm.errors import ConfigError, DataError
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
    return Dataset(FolderSource(Path(path), Options.of(facts)))


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


_log = logging.getLogger(__name__)


def write_trajectories(
    path: str | Path, trajectories: Runs | Mapping[str, Runs], scene: Scene | None = None, **facts: Any
) -> None:
    """Writes a dataset from arrays; or, for a scene that you state, one split of it.

    `nmpm.write_trajectories("grains", runs, dt=0.004)` writes the folder "grains": the last tenths of the runs test and
    validate, and what is not stated is found in the arrays and printed. Then `nmpm fit --data.path grains` trains on
    them.

    With a scene, call it once per split, for example with "mydata/train.h5", "mydata/valid.h5" and "mydata/test.h5".
    Trajectories are then written one by one and can come from a generator.

    Args:
        path: A folder that does not exist yet or is empty; with a scene, the file of a split.
        trajectories: Runs, each a (T, N, D) array of positions in domain length; a dict of arrays under usual names,
            such as {"position": …, "types": …, "velocity": …}; or a `Trajectory`. A (R, T, N, D) array holds R runs, a
            dict of such lists by "train", "valid" and "test" states the splits. NaN, a type of -1, and 0 in an array
            "active" mean that a particle is absent. With a scene, `particle_type` i of a `Trajectory` means
            `scene.materials[i]`, and the id after the last material, `len(scene.materials)`, static particles; bare
            arrays suffice for one material and no obstacles.
        scene: The trajectories' scene; left out, it is estimated.
        facts: Without a scene, what you know: `dt`, `gravity`, `bounds`, `boundary`, `types` (names by id), `static`
            (ids), and the other fields of `nmpm.data.convert.Options`.

    Raises:
        ConfigError: if the file is not named after a split, or a fact is invalid.
        DataError: if arrays do not fit together or the scene, existing metadata state another
            scene, or writing fails.
    """
    if scene is None:
        dataset = open_runs(trajectories, Options.of(facts))
        for note in write_native(dataset, Path(path)):
            sys.stdout.write(f"- {note}\n")
        return
    if facts:
        raise ConfigError(f"{', '.join(facts)}: the scene states these facts; leave them out, or the scene.")
    if isinstance(trajectories, Mapping):
        raise ConfigError("With a scene, give the runs of one split; without one, a dict of splits.")
    _write_split(Path(path), trajectories, scene)


def _write_split(path: Path, trajectories: Runs, scene: Scene) -> None:
    types = _types(scene)
    metadata = scene_metadata(scene, types, len(scene.materials) if scene.obstacles else None)
    if path.name not in {f"{split}.h5" for split in SPLITS}:
        raise ConfigError(f"{path}: the file must be named {', '.join(f'{s}.h5' for s in SPLITS[:-1])} or test.h5.")
    if (path.parent / METADATA_FILE).is_file():
        found = read_metadata(path.parent)
        if replace(found, sequence_length=1, extra={}) != replace(metadata, extra={}):
            raise DataError(f"{path.parent / METADATA_FILE}: states another scene. Choose another folder.")
        metadata = found
    lengths: list[int] = []
    write_split(path, _check_trajectories(trajectories, scene, path, lengths))
    longest = max(metadata.sequence_length, *lengths)
    write_metadata(path.parent, replace(metadata, sequence_length=longest))


def _check_trajectories(trajectories: Runs, scene: Scene, path: Path, lengths: list[int]) -> Iterator[Trajectory]:
    kinds = len(scene.materials) + scene.obstacles
    for index, item in enumerate(trajectories):
        where = f"{path}: trajectory {index}"
        if isinstance(item, Mapping):
            raise DataError(f"{where} is a dict: with a scene, give a Trajectory.")
        trajectory = item if isinstance(item, Trajectory) else _from_bare_array(item, kinds, where)
        position, types = trajectory.position, np.unique(trajectory.particle_type)
        if not isinstance(item, Trajectory) and (swapped := swapped_axes(position)):
            _log.warning("%s: %s", where, swapped)
        check_end(position, where)
        if position.shape[2] != scene.dim:
            raise DataError(f"{where} has {position.shape[2]} axes, the scene has {scene.dim}.")
        if types.min() < 0 or types.max() >= kinds:
            known = ", ".join(f"{i} {name}" for i, name in _types(scene).items())
            raise DataError(f"{where} has particle types {types.tolist()}; the scene has {known}.")
        if outside := first_outside(position, scene.domain, scene.boundary):
            frame, particle, _ = outside
            raise DataError(
                f"{where}, frame {frame}: particle {particle} is at {position[frame, particle].tolist()}, outside the"
                f" domain {list(map(list, scene.domain))}. Give the scene a domain that contains all positions."
            )
        missing = [name for name in scene.fields if name not in {*trajectory.fields, *trajectory.attributes}]
        if missing:
            raise DataError(f"{where} has no field {', '.join(missing)}, which the scene has: give Trajectory.fields.")
        lengths.append(len(position))
        yield trajectory


def _from_bare_array(position: np.ndarray, kinds: int, where: str) -> Trajectory:
    position = np.asarray(position)
    if kinds > 1:
        raise DataError(f"{where} is a bare array, but the scene has {kinds} particle types: give a Trajectory.")
    if position.ndim != 3 or position.dtype.kind != "f":
        raise DataError(f"{where} must be floats of shape (T, N, D); it is {position.dtype} {position.shape}.")
    return Trajectory(position, np.zeros(position.shape[1], dtype=np.int64))


def _types(scene: Scene) -> dict[int, str]:
    return dict(enumerate(scene.materials + (("boundary",) if scene.obstacles else ())))
