"""Trajectories on disk, in LagrangeBench's layout.

A dataset is a folder with `metadata.json` and `train.h5`, `valid.h5`, `test.h5`. In each file there is a group per
trajectory, named `00000`, `00001`, …, with the datasets `position` (T, N, D), float32, and `particle_type` (N,),
integer, and optional attributes such as `gravity` (D,) in length/s² and `seed`. All other datasets of a group, such as
`temperature` (T, N), are fields and kept unchanged. Two of them identify particles: `id` (N,), the number or text that
the data call a particle by, and `track` (T, N), the same where a column holds several particles one after the other.

A particle that is not there in a frame has NaN in all coordinates of its position there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from nmpm.data.array_checks import CORE, check_arrays, check_field, check_positions
from nmpm.data.hdf5 import (
    FILTERS,
    check_self_contained,
    check_stored_size,
    open_hdf5,
    writable_hdf5,
    write_compressed,
)
from nmpm.data.metadata import METADATA_FILE as METADATA_FILE
from nmpm.data.metadata import Metadata as Metadata
from nmpm.data.metadata import read_metadata as read_metadata
from nmpm.data.metadata import write_metadata as write_metadata
from nmpm.errors import DataError

SPLITS = ("train", "valid", "test")
OTHER_NAMES = {
    "train": ("training", "trn"),
    "valid": ("val", "validation", "eval", "dev"),
    "test": ("testing", "tst"),
}

_NO_DATA = frozenset({"Thumbs.db", "desktop.ini", "__MACOSX"})


def is_no_data(name: str) -> bool:
    """Whether files and folders of a name are hidden, or left by a system's file manager or archiver."""
    return name.startswith(".") or name in _NO_DATA


def describe_others(folder: Path) -> str:
    """The HDF5 files that a folder has, in brackets, for messages; nothing if there are none."""
    names = sorted(file.name for file in folder.glob("*.h5"))
    return f" (beside it: {', '.join(names)})" if names else ""


def split_paths(folder: Path) -> Mapping[str, Path]:
    """The split files in a dataset's folder, by name, in the order train, valid, test."""
    paths = {name: Path(folder) / f"{name}.h5" for name in SPLITS}
    return {name: path for name, path in paths.items() if path.exists()}


def find_split(folder: Path, *names: str) -> Path:
    """The file of the first of the named splits that a folder has; if none, a DataError names those there are."""
    paths = split_paths(folder)
    for name in names:
        if name in paths:
            return paths[name]
    missing = " or ".join(f"{name}.h5" for name in names)
    renames = "".join(f" {rename}" for rename in split_renames(folder, names))
    raise DataError(f"{folder}: no {missing} there{describe_others(Path(folder))}.{renames}")


def split_renames(folder: Path, names: Iterable[str] = SPLITS) -> list[str]:
    """Advice to rename files such as `val.h5`, a sentence for each, where the named split is missing."""
    paths = split_paths(folder)
    return [
        f"Rename {other}.h5 to {name}.h5."
        for name in names
        for other in OTHER_NAMES[name]
        if name not in paths and (Path(folder) / f"{other}.h5").is_file()
    ]


TRUTH = "truth"
"""Dataset of a prediction's group: the recorded positions (T', N, D) beside those that were predicted."""
MEMBER = "member"
"""Attribute of a trajectory that is a member of an ensemble: its number, from 0; neighbours count up."""
VTKHDF = "VTKHDF"
"""Group by which ParaView reads a file, see `nmpm.data.write.vtk`; it is not a trajectory."""
ID = "id"
"""Dataset of the numbers or texts (N,) that the particles have in the data; (T, N) texts beside `track`."""
TRACK = "track"
"""Dataset of numbers (T, N) that tell particles apart that share a column, one after the other with gaps between; -1
where there is none."""
_CHUNK_BYTES = 2**20
_LAYOUT = "expected a group per trajectory with `position` (T, N, D) and `particle_type` (N,)"


@dataclass(frozen=True)
class Trajectory:
    """One recorded run.

    Args:
        position: (T, N, D) float32, in domain length; NaN in all coordinates where a particle is absent.
        particle_type: (N,) int64 type ids.
        attributes: Further facts by name, e.g. `gravity` (D,) in length/s², `seed`.
        fields: Further arrays of numbers by name, of any shape and unit, e.g. `temperature` (T, N).
        metadata: Facts about its dataset, such as the names of types; None where they are not known.

    Raises:
        DataError: if the shapes do not fit together, a position is infinite or NaN in some coordinates only, or a field
            is not an array of numbers.
    """

    position: np.ndarray
    particle_type: np.ndarray
    attributes: dict[str, Any] = field(default_factory=dict)
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    metadata: Metadata | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_arrays(self.position, self.particle_type, "trajectory")
        object.__setattr__(self, "position", np.asarray(self.position, dtype=np.float32))
        object.__setattr__(self, "particle_type", np.asarray(self.particle_type, dtype=np.int64))
        check_positions(self.position, "trajectory", first_frame=0)
        for name, values in self.fields.items():
            check_field(name, values)

    def ids(self, kinds: str = "iu", first: int = 0) -> np.ndarray:
        """(T, N) numbers, or texts, by which the data call the particles; those of columns where they do not.

        Args:
            kinds: NumPy's kinds of ids that will do.
            first: Number of the first column.
        """
        sizes = self.position.shape[:2]
        stored: list[Any] = [np.asarray(self.fields[name]) for name in (ID, TRACK) if name in self.fields]
        fitting = [ids for ids in stored if ids.shape in (sizes, sizes[1:]) and ids.dtype.kind in kinds]
        ids: Any = fitting[0] if fitting else first + np.arange(sizes[1])
        return np.broadcast_to(np.char.decode(ids, "utf-8") if ids.dtype.kind == "S" else ids, sizes)


def write_split(path: Path, trajectories: Iterable[Trajectory]) -> None:
    """Writes trajectories, in order, into one file; equal trajectories give equal bytes."""
    # The earliest format has no time stamps in groups.
    with writable_hdf5(Path(path), libver=("earliest", "v108")) as (file, check_written):
        add_trajectories(file, trajectories, check_written, Path(path))


def add_trajectories(
    file: Any, trajectories: Iterable[Trajectory], check_written: Callable[[], None], path: Path
) -> None:
    """As `write_split`, into an empty HDF5 file that `writable_hdf5` has opened."""
    count = 0
    for count, trajectory in enumerate(trajectories, start=1):
        _write_trajectory(file.create_group(f"{count - 1:05d}"), trajectory)
        check_written()
    if not count:
        raise DataError(f"{path}: there are no trajectories to write.")


def _write_trajectory(group: Any, trajectory: Trajectory) -> None:
    frames, particles, dim = trajectory.position.shape
    chunk = min(frames, max(1, _CHUNK_BYTES // (4 * particles * dim)))
    write_compressed(group, "position", trajectory.position, chunk)
    group.create_dataset("particle_type", data=trajectory.particle_type)
    for name in sorted(trajectory.fields):
        values = np.asarray(trajectory.fields[name])
        group.create_dataset(name, data=values, **(FILTERS if values.size > 1 else {}))
    for name in sorted(trajectory.attributes):
        try:
            group.attrs[name] = trajectory.attributes[name]
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            raise DataError(
                f"the attribute {name[:40]!r} = {str(trajectory.attributes[name])[:40]} cannot be stored ({error})."
            ) from error


@dataclass(frozen=True)
class _Entry:
    name: str
    frames: int
    particles: int
    dim: int


class Split:
    """The trajectories of an HDF5 file, read on access. Keeps no file open, so that it can be pickled and shared.

    Args:
        path: The file.
        span: The frames of each trajectory that count, as if there were no others; all of them when left out.

    Raises:
        DataError: if the file is missing, damaged, not of the layout above, or takes content from other files.
    """

    def __init__(self, path: Path, span: slice = slice(None)) -> None:
        self.path, self.span = Path(path), span
        if not self.path.exists():
            raise DataError(f"{self.path}: no such file{describe_others(self.path.parent)}.")
        if not self._entries:
            raise DataError(f"{self.path}: the file has no trajectory; {_LAYOUT}.")

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the trajectories, in order."""
        return tuple(entry.name for entry in self._entries)

    @property
    def dim(self) -> int:
        """Number of space dimensions, the same for all trajectories."""
        return self._entries[0].dim

    def frames(self, index: int) -> int:
        """Number of frames, T, of a trajectory."""
        return len(self._frames(index))

    def _frames(self, index: int) -> range:
        """The frames of the file that count."""
        return range(self._entries[index].frames)[self.span]

    def particles(self, index: int) -> int:
        """Number of particles, N, of a trajectory, static ones included."""
        return self._entries[index].particles

    def sample(self, size: int = 2**27) -> range:
        """Indices of evenly spaced trajectories, with up to about `size` bytes of positions in all."""
        total = sum(4 * self.frames(index) * self.particles(index) * self.dim for index in range(len(self)))
        return range(0, len(self), max(1, -(-total // size)))

    def spread(self, most: int) -> range:
        """Indices of evenly spaced trajectories, at most so many."""
        return range(0, len(self), -(-len(self) // most))

    def where(self, index: int) -> str:
        """File and trajectory, for error messages."""
        frames = self._frames(index)
        part = f", frames {frames.start} to {frames.stop - 1}" if len(frames) < self._entries[index].frames else ""
        return f"{self.path}, trajectory {self._entries[index].name}{part}"

    def particle_type(self, index: int) -> np.ndarray:
        """The (N,) int64 type ids of a trajectory."""
        with open_hdf5(self.path) as file:
            return np.asarray(file[self._entries[index].name]["particle_type"][()], dtype=np.int64)

    def time(self, index: int) -> np.ndarray | None:
        """The (T,) float64 times of a trajectory's frames, its field `time`; None where it has none."""
        time = self.stored(index, ["time"]).get("time")
        if time is None or time.shape != (self.frames(index),) or time.dtype.kind not in "iuf":
            return None
        return time.astype(np.float64)

    def tracks(self, index: int) -> np.ndarray | None:
        """The (T, N) numbers of the particles in each column, its field `track`; None where each holds one alone."""
        tracks = self.stored(index, [TRACK]).get(TRACK)
        sizes = (self.frames(index), self.particles(index))
        return tracks if tracks is not None and tracks.shape == sizes and tracks.dtype.kind in "iu" else None

    def ids(self, index: int) -> np.ndarray:
        """The (N,) or (T, N) numbers or texts by which the data call particles; those of columns where they do not."""
        sizes = (self.frames(index), self.particles(index))
        stored = self.stored(index, (ID, TRACK)).values()
        return next((ids for ids in stored if ids.shape in (sizes, sizes[1:])), np.arange(sizes[1]))

    def attributes(self, index: int) -> dict[str, Any]:
        """The attributes of a trajectory."""
        with open_hdf5(self.path) as file:
            return dict(file[self._entries[index].name].attrs)

    def fields(self, index: int) -> dict[str, np.ndarray]:
        """All datasets of a trajectory except its positions and types by name; a DataError if one has no numbers."""
        fields = self.stored(index)
        for name, values in fields.items():
            check_field(name, values, self.where(index))
        return fields

    def stored(self, index: int, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Those of the named datasets that a trajectory has, or all except its positions and types.

        Of those that are by frame, the frames that count.
        """
        entry, stored = self._entries[index], dict[str, np.ndarray]()
        with open_hdf5(self.path) as file:
            group = file[entry.name]
            for name in group if names is None else names:
                values = group.get(name)
                if name not in CORE and isinstance(values, h5py.Dataset):
                    check_stored_size(values, f"{self.where(index)}: {name}")
                    sizes = (entry.frames,) if name == "time" else (entry.frames, entry.particles)
                    by_frame = values.shape[: len(sizes)] == sizes
                    stored[name] = np.asarray(values[self.span if by_frame else ()])
        return stored

    def read_with_fields(self, index: int) -> Trajectory:
        """Reads a trajectory with its fields."""
        return replace(self.read(index), fields=self.fields(index))

    def read(self, index: int, start: int = 0, stop: int | None = None) -> Trajectory:
        """Reads the frames from `start` up to `stop` (to the end when None) of a trajectory, without its fields.

        Raises:
            DataError: if they cannot be read, or a position is infinite or NaN in some coordinates only.
        """
        name = self._entries[index].name  # an IndexError ends iterations, within `open_hdf5` it would be a DataError
        frames = self._frames(index)[start:stop]
        with open_hdf5(self.path) as file:
            group = file[name]
            position = np.asarray(group["position"][frames.start : frames.stop], dtype=np.float32)
            particle_type = np.asarray(group["particle_type"][()], dtype=np.int64)
            attributes = dict(group.attrs)
        check_positions(position, self.where(index), first_frame=frames.start)
        return Trajectory(position, particle_type, attributes)

    @cached_property
    def _entries(self) -> tuple[_Entry, ...]:
        with open_hdf5(self.path) as file:
            check_self_contained(file, self.path)
            # By names: an error within `items()` would keep HDF5 locked for other threads as long as its traceback.
            entries = tuple(_entry(file.get(name), name, self.path) for name in file if name != VTKHDF)
        for entry in entries:
            if entry.dim != entries[0].dim:
                raise DataError(
                    f"{self.path}, trajectory {entry.name}: {entry.dim} dimensions, {entries[0].dim} in the others."
                )
        return entries


def _entry(group: Any, name: str, path: Path) -> _Entry:
    where = f"{path}, trajectory {name}"
    if not isinstance(group, h5py.Group):
        raise DataError(f"{path}: {name!r} is not a group; {_LAYOUT}.")
    missing = [key for key in CORE if not isinstance(group.get(key), h5py.Dataset)]
    if missing:
        names = ", ".join(group) or "nothing"
        raise DataError(f"{where}: the key {' and '.join(map(repr, missing))} is missing (found: {names}); {_LAYOUT}.")
    check_arrays(group["position"], group["particle_type"], where)
    for key in CORE:
        check_stored_size(group[key], f"{where}: {key}")
    frames, particles, dim = group["position"].shape
    return _Entry(name, frames, particles, dim)


def is_native(folder: Path) -> bool:
    """Whether a folder has split files in the native layout; those of a folder with metadata are not looked into."""
    paths = split_paths(folder)
    if not paths or (Path(folder) / METADATA_FILE).is_file():
        return bool(paths)
    try:
        return bool(Split(next(iter(paths.values()))))
    except DataError:
        return False
