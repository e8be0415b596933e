"""Arrays of a frame: `.npy`, `.npz` or HDF5 files of one frame each, or HDF5 with a group for each frame.

Positions are (N, D), or x, y and z (N,), or columns of a table that are called so (CB-Geo). Groups that have positions,
such as PySPH's fluid and boundary, are materials.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm.data.convert.array_files import ArrayFiles, open_arrays
from nmpm.data.convert.frame_files import FrameFormat, by_kind, is_other_name
from nmpm.data.convert.frames import Frame, join_frames
from nmpm.data.convert.named_arrays import (
    ArrayLike,
    Arrays,
    by_plain_name,
    component_names,
    describe,
    with_meaning,
)
from nmpm.errors import DataError, NmpmError

_FRAME_NAME = re.compile(r"(?:arr|frame|iter|iteration|output|snapshot|state|step|t|time|timestep)?[_#. -]?(\d{1,18})")


class ArrayFrames(FrameFormat):
    """A file, or a group, per frame."""

    summary: ClassVar[str] = "a file per frame of arrays in .npz, .npy, .h5, .hdf5: positions (N, D), or x, y, z"
    patterns: tuple[str, ...] = ArrayFiles.patterns

    def recognises(self, path: Path) -> bool:
        _, files = next(self._folders(path), (path, []))
        for first, *others in by_kind(files).values():
            with suppress(NmpmError, OSError):
                if len(list(islice(self.frames(first), 2))) + bool(others) > 1:
                    return True
        return False

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_arrays(file) as arrays:
            for name, inside in _by_frame(_plain(arrays)).items():
                yield _frame(inside, f"{file}: {name}" if name else str(file))

    def count(self, file: Path) -> int:
        with open_arrays(file) as arrays:
            return len(_by_frame(_plain(arrays)))


def _plain(arrays: Arrays) -> dict[str, ArrayLike]:
    """The arrays, and the columns of tables."""
    plain: dict[str, ArrayLike] = {}
    for name, array in arrays.items():
        if array.dtype.names:
            table = np.asarray(array[()]).reshape(-1)
            plain |= {f"{name}/{column}": table[column] for column in array.dtype.names}
        else:
            plain[name] = array
    return plain


def _by_frame(arrays: Arrays) -> dict[str, dict[str, ArrayLike]]:
    """The arrays of each frame: of a group, or an array, that is called like one; else those of the whole file."""
    frames: dict[str, dict[str, ArrayLike]] = {}
    for name, array in arrays.items():
        group, _, inner = name.partition("/")
        if _FRAME_NAME.fullmatch(group.lower()):
            frames.setdefault(group, {})[inner or "position"] = array
    holders = [name for name, inside in frames.items() if any(map(_position, _by_group(inside).values()))]
    if not holders:
        return {"": dict(arrays)}
    return {name: frames[name] for name in sorted(holders, key=_number)}


def _number(name: str) -> int:
    return int(re.findall(r"\d+", name)[-1])


def _by_group(arrays: Arrays) -> dict[str, dict[str, ArrayLike]]:
    groups: dict[str, dict[str, ArrayLike]] = {}
    for name, array in arrays.items():
        group, _, leaf = name.rpartition("/")
        groups.setdefault(group, {})[leaf] = array
    return groups


def _frame(arrays: Arrays, where: str) -> Frame:
    groups = {name: inside for name, inside in _by_group(arrays).items() if _position(inside)}
    others = [name for name in groups if is_other_name(name)]
    if len(others) < len(groups):
        groups = {name: inside for name, inside in groups.items() if name not in others}
    if not groups:
        raise DataError(f"{where}: no array can be positions (N, D) or x, y, z ({describe(arrays)}).")
    time, step = (_fact(arrays, meaning) for meaning in ("time", "step"))
    whole = None if step is None else int(step)
    names = _materials(list(groups))
    parts = [(names[group], _particles(inside, time, whole)) for group, inside in groups.items()]
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


def _fact(arrays: Arrays, meaning: str) -> float | None:
    """The number, anywhere in a frame, that is called so; None if there is none."""
    numbers = {
        name.rpartition("/")[2]: array
        for name, array in arrays.items()
        if array.shape in ((), (1,)) and array.dtype.kind in "iuf"
    }
    found = with_meaning(meaning, numbers)
    return float(np.asarray(numbers[found[0]][()]).reshape(-1)[0]) if found else None


def _materials(groups: list[str]) -> Mapping[str, str]:
    """Names of materials by their groups: the parts of the paths that differ."""
    parts = [group.split("/") for group in groups]
    shared = set.intersection(*map(set, parts))
    return {
        group: "_".join(part for part in path if part not in shared) or "particles"
        for group, path in zip(groups, parts, strict=True)
    }
