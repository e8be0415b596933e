"""Files of arrays under usual names: NumPy's `.npz` and `.npy`, HDF5, MATLAB's `.mat`, and folders of them.

A file holds one run, or several: stacked, numbered, or in groups (`nmpm.data.convert.run_arrays`). A folder of `.npy`
files of which one is called positions, and the others types, velocities and the like, is one run. Or a file holds a
frame, or HDF5 a group for each frame: positions are (N, D), or x, y and z (N,), or columns of a table that are called
so (CB-Geo); groups that have positions, such as PySPH's fluid and boundary, are materials. Objects are not unpickled.

MATLAB's files of v7.3 are HDF5; older ones are read by scipy in a child process. Fields of structs are named
`struct/field`, entries of cells `cell_0`, `cell_1`, …; axes of one are left out, as MATLAB adds them to vectors and
numbers.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from nmpm._support.bounded_files import EXPANSION, NPZ_ERRORS, check_regular, expansion_limit
from nmpm._support.isolated import call_isolated
from nmpm._support.messages import one_line
from nmpm.data.convert.base import Facts, Options, Run, RunFiles, readable, split_files
from nmpm.data.convert.frame_files import FrameFormat, by_kind, has_other_word
from nmpm.data.convert.frames import Frame, join_frames
from nmpm.data.convert.named_arrays import (
    USUAL_NAMES,
    ArrayLike,
    Arrays,
    by_folder,
    by_plain_name,
    component_names,
    describe,
    plain_name,
    with_meaning,
)
from nmpm.data.convert.run_arrays import group_runs
from nmpm.data.format import VTKHDF, Metadata, Trajectory, is_no_data
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5
from nmpm.errors import DataError, NmpmError

_FRAME_NAME = re.compile(r"(?:arr|frame|iter|iteration|output|snapshot|state|step|t|time|timestep)?[_#. -]?(\d{1,18})")


class ArrayFiles(RunFiles):
    """Files of arrays: positions (T, N, D) or (R, T, N, D), and whatever fits them."""

    summary: ClassVar[str] = "positions (T, N, D) or (R, T, N, D) in .npz, .npy, .h5, .mat, by usual names"
    patterns: tuple[str, ...] = ("*.npz", "*.npy", "*.h5", "*.hdf5", "*.mat")

    def recognises(self, path: Path) -> bool:
        first = next(iter(self.files(path).values()), ())
        runs = self.runs(first[0]) if first else ()
        return bool(runs) and ([run.frames for run in runs] != [1] or path.is_file())

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        if is_array_folder(path):
            return {"all": (path,)}
        folders = {} if path.is_file() else split_files(path, "*/", unsplit="all")
        runs = {split: tuple(filter(is_array_folder, inside)) for split, inside in folders.items()}
        return {split: inside for split, inside in runs.items() if inside} or super().files(path)

    def runs(self, file: Path) -> Sequence[Run]:
        with open_arrays(file) as arrays:
            groups = list(group_runs(arrays, str(file)))
            if not groups:
                raise DataError(f"{file}: no array can be positions ({describe(arrays)}). Move it to another folder.")
        numbered = [group for group in groups for _ in range(group.count)]
        return [Run(file, index, group.frames, group.split) for index, group in enumerate(numbered)]

    def facts(self, file: Path, options: Options) -> Facts:  # noqa: ARG002
        with open_arrays(file) as arrays:
            return next(group_runs(arrays, str(file))).facts()

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        wanted = set(indices)
        with open_arrays(file) as arrays:
            runs = ((group, run) for group in group_runs(arrays, str(file)) for run in range(group.count))
            for index, (group, run) in enumerate(runs):
                if index in wanted:
                    yield group.read(run, metadata)


class ArrayFrames(FrameFormat):
    """A file, or a group, per frame."""

    summary: ClassVar[str] = "a file per frame of arrays in .npz, .npy, .h5, .hdf5: positions (N, D), or x, y, z"
    patterns: tuple[str, ...] = ArrayFiles.patterns

    def recognises(self, path: Path) -> bool:
        for first, *others in by_kind(self.first_files(path)).values():
            with suppress(NmpmError, OSError):
                if len(list(islice(self.frames(first), 2))) + bool(others) > 1:
                    return True
        return False

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_arrays(file) as arrays:
            for name, inside in _by_frame(arrays).items():
                yield _frame(inside, f"{file}: {name}" if name else str(file))

    def count(self, file: Path) -> int:
        with open_arrays(file) as arrays:
            return len(_by_frame(arrays))


def _by_frame(arrays: Arrays) -> dict[str, dict[str, ArrayLike]]:
    """The arrays of each frame: of a group, or an array, that is called like one; else those of the whole file."""
    plain: dict[str, ArrayLike] = {}  # with the columns of tables
    for name, array in arrays.items():
        if array.dtype.names:
            table = np.asarray(array[()]).reshape(-1)
            plain |= {f"{name}/{column}": table[column] for column in array.dtype.names}
        else:
            plain[name] = array
    frames: dict[str, dict[str, ArrayLike]] = {}
    for name, array in plain.items():
        group, _, inner = name.partition("/")
        if _FRAME_NAME.fullmatch(group.lower()):
            frames.setdefault(group, {})[inner or "position"] = array
    holders = [name for name, inside in frames.items() if any(map(_position, by_folder(inside).values()))]
    holders.sort(key=lambda name: int(re.findall(r"\d+", name)[-1]))
    return {name: frames[name] for name in holders} or {"": plain}


def _frame(arrays: Arrays, where: str) -> Frame:
    groups = {name: inside for name, inside in by_folder(arrays).items() if _position(inside)}
    groups = {name: inside for name, inside in groups.items() if not has_other_word(name)} or groups
    if not groups:
        raise DataError(f"{where}: no array can be positions (N, D) or x, y, z ({describe(arrays)}).")
    numbers = {
        name.rpartition("/")[2]: array
        for name, array in arrays.items()
        if array.shape in ((), (1,)) and array.dtype.kind in "iuf"
    }

    def fact(meaning: str) -> float | None:
        named = with_meaning(meaning, numbers)
        return float(np.asarray(numbers[named[0]][()]).reshape(-1)[0]) if named else None

    time, step = fact("time"), fact("step")
    whole = None if step is None else int(step)
    shared = set.intersection(*(set(group.split("/")) for group in groups))
    parts = list[tuple[str, Frame]]()
    for group, inside in groups.items():
        material = "_".join(part for part in group.split("/") if part not in shared) or "particles"
        parts.append((material, _particles(inside, time, whole)))
    return join_frames(parts) if len(parts) > 1 else parts[0][1]


def _position(arrays: Arrays) -> tuple[str, ...]:
    """Names of the positions of a frame, or of their components; () if there are none."""
    for name in with_meaning("position", arrays):
        *one, count, dim = arrays[name].shape if len(arrays[name].shape) > 1 else (0, 0)
        if dim in (2, 3) and count > 0 and one in ([], [1]) and arrays[name].dtype.kind in "iuf":
            return (name,)
    flat = [name for name, array in arrays.items() if len(array.shape) == 1 and array.dtype.kind in "iuf"]
    names = component_names(by_plain_name(flat), "position")
    return names if len({arrays[name].shape for name in names}) == 1 else ()


def _particles(arrays: Arrays, time: float | None, step: int | None) -> Frame:
    names = _position(arrays)
    parts = [np.asarray(arrays[name][()], np.float64) for name in names]
    position = np.stack(parts, axis=1) if len(parts) > 1 else parts[0].reshape(-1, parts[0].shape[-1])
    values: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        shape = tuple(array.shape)
        shape = shape[1:] if len(shape) > 1 and shape[0] == 1 != len(position) else shape
        if name not in names and shape[:1] == (len(position),) and array.dtype.kind in "biufSU":
            flat = np.asarray(array[()]).reshape(len(position), -1)
            values[name] = flat[:, 0] if len(shape) == 1 else flat
    left_out = tuple(
        name for name, array in arrays.items() if name not in values and name not in names and len(array.shape) > 0
    )
    return Frame(position, values, time, step, left_out=left_out)


def is_array_folder(path: Path) -> bool:
    """Whether the `.npy` files of a folder are positions and what belongs to them, not a run each."""
    if not path.is_dir():
        return False
    names = {plain_name(file.stem) for file in _npy_files(path)}
    positions = names & set(USUAL_NAMES["position"])
    return bool(positions) and any(names - positions & set(usual) for usual in USUAL_NAMES.values())


@contextmanager
def open_arrays(path: Path) -> Iterator[Arrays]:
    """The arrays of a file or folder by name, read when indexed, while the context lasts.

    Raises:
        DataError: if it cannot be read, holds objects, or unpacks to far more than its size.
    """
    if path.is_dir():
        yield {file.stem: _open_npy(file) for file in _npy_files(path)}
        return
    check_regular(path)
    if path.suffix == ".npy":
        yield {"position": _open_npy(path)}
    elif path.suffix == ".npz":
        members = npz_members(path)
        with zipfile.ZipFile(path) as archive:
            yield {name: NpzArray(archive, name, f"{path}: {one_line(name, 60)}") for name in members}
    elif path.suffix == ".mat" and not h5py.is_hdf5(path):
        yield call_isolated(read_mat, path)
    else:
        with open_hdf5(path) as file:
            check_self_contained(file, path)
            arrays = _hdf5_arrays(file, path)
            yield dict(_as_in_matlab(arrays, file, path) if path.suffix == ".mat" else arrays)


def _npy_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("*.npy") if not is_no_data(file.name))


def _open_npy(path: Path) -> np.ndarray:
    check_regular(path)
    with readable(path, "an array of numbers", *NPZ_ERRORS):
        array: np.ndarray = np.load(path, mmap_mode="r", allow_pickle=False)
    return array


def _hdf5_arrays(file: Any, path: Path) -> Iterator[tuple[str, ArrayLike]]:
    """Datasets and numbers in attributes, by path in the file; groups of soft links have another name."""
    pending = [file]
    while pending:
        group = pending.pop()
        prefix = group.name.strip("/") + "/" if group.name != "/" else ""
        for name, value in group.attrs.items():
            if name not in group and np.asarray(value).dtype.kind in "biuf":
                yield prefix + name, np.asarray(value)
        groups = []
        for name in group:
            item, linked = group.get(name), isinstance(group.get(name, getlink=True), h5py.SoftLink)
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                check_stored_size(item, f"{path}: {prefix}{name}")
                yield prefix + name, item
            elif isinstance(item, h5py.Group) and not linked and name not in (VTKHDF, "#refs#"):
                groups.append(item)
        pending += reversed(groups)


def _as_in_matlab(arrays: Iterator[tuple[str, Any]], file: Any, path: Path) -> Iterator[tuple[str, ArrayLike]]:
    """The datasets of numbers with MATLAB's axes; the entries of cells, which the group `#refs#` holds, by number."""
    for name, array in arrays:
        items = [(name, array)]
        if array.dtype == h5py.ref_dtype:
            entries = (file[reference] for reference in array[()].T.flat if reference)
            items = [(f"{name}_{index}", entry) for index, entry in enumerate(entries)]
        for where, item in items:
            numbers = isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf"
            if numbers and item.attrs.get("MATLAB_class") != b"char":
                check_stored_size(item, f"{path}: {where}")
                yield where, _AsInMatlab(item)


@dataclass(frozen=True)
class _AsInMatlab:
    """A dataset with its axes as in MATLAB, which stores the last one first, but for those of size one."""

    dataset: Any

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(size for size in reversed(self.dataset.shape) if size != 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        kind: np.dtype[Any] = self.dataset.dtype
        return kind

    def __getitem__(self, rows: Any) -> np.ndarray:
        return np.asarray(np.asarray(self.dataset[()]).T.reshape(self.shape)[rows])


def read_mat(path: str) -> dict[str, np.ndarray]:
    """The arrays of a MATLAB file before v7.3, by name; for child processes."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    def flat(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from flat(f"{name}/{key}" if name else str(key), inner)
        elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.hasobject):
            for index, inner in enumerate(value):
                yield from flat(f"{name}_{index}", inner)
        elif (array := np.asarray(value)).dtype.kind in "biufUS":
            yield name, array

    errors = (MatReadError, zlib.error, TypeError, LookupError, ArithmeticError, NotImplementedError, RecursionError)
    with readable(path, "a MATLAB file", *errors):
        content = loadmat(path, simplify_cells=True)
        return dict(flat("", {name: value for name, value in content.items() if not name.startswith("__")}))


class NpzArray:
    """A member of an `.npz` file, read row by row; cheap where they are read in order.

    Args:
        archive: The open file.
        name: The member, without its suffix.
        where: For messages.

    Raises:
        DataError: if the member is damaged.
    """

    def __init__(self, archive: zipfile.ZipFile, name: str, where: str) -> None:
        self._where = where
        with readable(self._where, "an array", *NPZ_ERRORS):
            self._file: Any = archive.open(f"{name}.npy")
            version = np.lib.format.read_magic(self._file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            self.shape, self._fortran, self.dtype = read(self._file)
            self._start = self._file.tell()

    def __getitem__(self, rows: int | tuple[()]) -> np.ndarray:
        if self.dtype.hasobject:
            raise DataError(
                f"{self._where}: holds Python objects, which are not unpickled. Save numbers, or texts by .astype(str)."
            )
        if isinstance(rows, tuple):
            return self._read(0, self.shape).reshape(self.shape, order="F" if self._fortran else "C")
        if self._fortran:
            whole: np.ndarray = self[()][rows]
            return whole
        return self._read(rows, self.shape[1:]).reshape(self.shape[1:])

    def pickled(self) -> bytes:
        """The content of an array of objects."""
        with readable(self._where, "an array", *NPZ_ERRORS):
            self._file.seek(self._start)
            content: bytes = self._file.read()
            return content

    def _read(self, block: int, shape: tuple[int, ...]) -> np.ndarray:
        """The numbers of one of the blocks of equal shape that follow each other."""
        count = math.prod(shape)
        with readable(self._where, "an array", *NPZ_ERRORS):
            self._file.seek(self._start + block * count * self.dtype.itemsize)
            data = self._file.read(count * self.dtype.itemsize)
            if len(data) != count * self.dtype.itemsize:
                raise ValueError(f"{len(data)} bytes are not {count} numbers of {self.dtype}")
            return np.frombuffer(data, self.dtype)


def npz_members(path: Path) -> tuple[str, ...]:
    """Names of the members, ordered by the numbers in them."""
    check_regular(path)
    with readable(path, ".npz", *NPZ_ERRORS), zipfile.ZipFile(path) as file:
        items = [item for item in file.infolist() if item.filename.endswith(".npy")]
    if not items:
        raise DataError(f"{path}: the file has no array.")
    unpacked = sum(item.file_size for item in items)
    if unpacked > expansion_limit(path.stat().st_size):
        raise DataError(f"{path}: unpacks to {unpacked:,} bytes, more than {EXPANSION} times its size.")
    names = [item.filename.removesuffix(".npy") for item in items]
    return tuple(sorted(names, key=lambda name: [int(part) for part in re.findall(r"\d{1,18}", name)]))
