"""VTKHDF files, `.vtkhdf`: poly data or an unstructured grid, with time steps or a file per frame; read by h5py.

The points of all time steps are in one array; `Steps` says where those of each step begin (https://docs.vtk.org,
"VTKHDF file format").
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame
from nmpm.data.format import VTKHDF
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5
from nmpm.errors import DataError

_BLOCK_BYTES = 2**24
_TYPES = ("PolyData", "UnstructuredGrid")


class VtkHdf(FrameFormat):
    """VTKHDF files of points."""

    summary: ClassVar[str] = "VTKHDF files of points (.vtkhdf), with time steps or a file per frame"
    patterns: tuple[str, ...] = ("*.vtkhdf",)

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_hdf5(file) as content:
            root = _root(content, file)
            rows = {name: _Rows(values) for name, values in root.get("PointData", {}).items()}
            points = _Rows(root["Points"])
            for count, first, starts, time in _steps(root):
                position = points.take(first, count).astype(np.float64)
                yield Frame(position, {name: rows[name].take(starts.get(name, first), count) for name in rows}, time)

    def count(self, file: Path) -> int:
        with open_hdf5(file) as content:
            root = _root(content, file)
            return sum(1 for _ in _steps(root))


def _root(content: Any, file: Path) -> Any:
    """The group of the points.

    Raises:
        DataError: if there is none, or it takes content from other files.
    """
    check_self_contained(content, file)
    root = content.get(VTKHDF)
    if not isinstance(root, h5py.Group):
        raise DataError(f"{file}: there is no group {VTKHDF} in it.")
    kind = root.attrs.get("Type", b"nothing")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if kind not in _TYPES:
        raise DataError(f"{file}: it has a {one_line(kind, 40)}; particles are points, as {' or '.join(_TYPES)}.")
    for name in ("", "PointData", "Steps", "Steps/PointDataOffsets"):
        for key, values in root[name or "/" + VTKHDF].items() if name in root or not name else ():
            if isinstance(values, h5py.Dataset):
                check_stored_size(values, f"{file}: {name}/{key}".replace(" /", " "))
    for name, values in (("Points", root["Points"]), *root.get("PointData", {}).items()):
        fits = values.shape[1:] == (3,) if name == "Points" else values.ndim in (1, 2)
        if not fits or values.dtype.kind not in "biufSO":
            raise DataError(f"{file}: {one_line(name, 40)} is {values.dtype} {values.shape}; expected a row per point.")
    return root


def _steps(root: Any) -> Iterator[tuple[int, int, dict[str, int], float | None]]:
    """Yields the number of points of each step, the index of the first, that of each array, and the time."""
    points = root["NumberOfPoints"][()]
    if "Steps" not in root:
        stated = (each for name, each in root.get("FieldData", {}).items() if name.lower() in ("timevalue", "time"))
        time = next((float(values[0]) for values in stated if values.shape == (1,)), None)
        yield int(points.sum()), 0, {}, time
        return
    steps, number = root["Steps"], int(root["Steps"].attrs["NSteps"])
    if not 0 <= number <= min(len(steps["Values"]), len(steps["PartOffsets"])):
        raise DataError(f"{root.file.filename}: it has not as many steps as NSteps = {number:,}. Is it complete?")
    starts = {name: values[()] for name, values in steps.get("PointDataOffsets", {}).items()}
    firsts, times, parts = (steps[name][:number] for name in ("PointOffsets", "Values", "PartOffsets"))
    counts = steps["NumberOfParts"][:number] if "NumberOfParts" in steps else np.ones(number, int)
    for step in range(number):
        count = int(points[parts[step] : parts[step] + counts[step]].sum())
        yield count, int(firsts[step]), {name: int(each[step]) for name, each in starts.items()}, float(times[step])


class _Rows:
    """Rows of a dataset, read in blocks: a step alone would unpack a whole chunk."""

    def __init__(self, dataset: Any) -> None:
        self._dataset, self._first, self._rows = dataset, 0, dataset[:0]

    def take(self, first: int, count: int) -> np.ndarray:
        """Some rows; raises a DataError if there are fewer."""
        if first < self._first or first + count > self._first + len(self._rows):
            block = _BLOCK_BYTES // max(1, self._dataset.dtype.itemsize * math.prod(self._dataset.shape[1:]))
            self._first, self._rows = first, self._dataset[first : first + max(count, block)]
        rows = np.asarray(self._rows[first - self._first :][:count])
        if len(rows) != count or first < 0:
            name = self._dataset.name.removeprefix(f"/{VTKHDF}/")
            raise DataError(f"{self._dataset.file.filename}: {count} rows of {name} from {first} on are not there.")
        return rows
