"""H5MD, as LAMMPS, ESPResSo and HALMD write it: HDF5 with `particles/GROUP/position/value` and its steps and times.

Groups are materials, but for `all`, of which others are parts (https://nongnu.org/h5md/h5md.html, version 1.1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame, join_frames, wrap
from nmpm.data.convert.named_arrays import as_text
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5
from nmpm.errors import DataError
from nmpm.scene import Boundary, Interval

_ALL = "all"


class H5md(FrameFormat):
    """Files of many frames; particles are matched by `id`, where there is one."""

    summary: ClassVar[str] = "H5MD (.h5, .h5md): particles/GROUP/position/value"
    patterns: tuple[str, ...] = ("*.h5md", "*.h5", "*.hdf5")

    def recognises(self, path: Path) -> bool:
        return any(self.count(files[0]) for _, files in self._folders(path))

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_hdf5(file) as content:
            check_self_contained(content, file)
            groups = [_Group(group, f"{file}: {name}") for name, group in _groups(content).items()]
            for index in range(min((group.count for group in groups), default=0)):
                parts = [(group.name, group.frame(index)) for group in groups]
                yield join_frames(parts) if len(parts) > 1 else parts[0][1]

    def count(self, file: Path) -> int:
        with open_hdf5(file) as content:
            return min((_Group(group, f"{file}: {name}").count for name, group in _groups(content).items()), default=0)


def _groups(content: Any) -> dict[str, Any]:
    """The groups of particles, by name; none in other HDF5 files."""
    particles = content.get("particles")
    groups = dict(particles.items()) if isinstance(particles, h5py.Group) else {}
    groups = {
        name: group
        for name, group in groups.items()
        if isinstance(group, h5py.Group)
        and isinstance(group.get("position"), h5py.Group)
        and isinstance(group["position"].get("value"), h5py.Dataset)
    }
    return {_ALL: groups[_ALL]} if _ALL in groups else groups


class _Group:
    """A group of particles with its elements, which are the same in all frames or have values at some steps."""

    def __init__(self, group: Any, where: str) -> None:
        self.name, self._where, self._box = group.name.rpartition("/")[2], where, group.get("box")
        self._elements = {
            name: _Element.of(item, f"{where}/{name}")
            for name, item in group.items()
            if name not in ("box", "image") and (isinstance(item, h5py.Dataset) or "value" in item)
        }
        self._position = self._elements.pop("position")
        shape = self._position.values.shape
        if len(shape) != 3 or not 1 <= shape[2] <= 3:
            raise DataError(f"{where}/position/value: its shape is {tuple(shape)}, not frames, particles, 1 to 3 axes.")
        self.count = shape[0]  # of frames
        edges = self._box.get("edges") if isinstance(self._box, h5py.Group) else None
        self._edges = None if edges is None else _Element.of(edges, f"{where}/box/edges")
        self._low = 0.0
        if self.count and self._edges is not None and (self._position.row(0) < 0).any():
            self._low = -0.5  # of the edges: HALMD's boxes are about the origin

    def frame(self, index: int) -> Frame:
        """The particles of a frame."""
        position = np.asarray(self._position.row(index), np.float64)
        step, time = self._position.step(index), self._position.time(index)
        arrays = {}
        for name, element in self._elements.items():
            row = element.row_at(index, step)
            if row is not None and row.shape[:1] == position.shape[:1] and row.ndim <= 2:
                arrays[name] = row
        left_out = tuple(name for name in self._elements if name not in arrays)
        box, boundary = self._box_at(index, step)
        return Frame(wrap(position, box, boundary), arrays, time, step, box, boundary, left_out)

    def _box_at(self, index: int, step: int | None) -> tuple[tuple[Interval, ...] | None, tuple[Boundary, ...] | None]:
        """The box and its boundary, where an axis is periodic; else neither is stated."""
        kinds = np.asarray(self._box.attrs.get("boundary", ())) if self._edges is not None else np.zeros(0)
        periodic = [text == "periodic" for text in as_text(kinds).flat]
        edges = None if self._edges is None else self._edges.row_at(index, step)
        if edges is None or not any(periodic):
            return None, None
        if edges.ndim == 2 and (edges != np.diag(np.diag(edges))).any():
            raise DataError(f"{self._where}/box: it is not rectangular; only rectangular boxes can be read.")
        lengths = np.broadcast_to(np.diag(edges) if edges.ndim == 2 else edges, len(periodic)).astype(np.float64)
        box = tuple((self._low * length, (self._low + 1) * length) for length in lengths.tolist())
        return box, tuple("periodic" if wraps else "wall" for wraps in periodic)


@dataclass(frozen=True)
class _Element:
    """The values of an element: the same in all frames, or a row for each of its steps."""

    values: Any
    steps: Any = None  # (rows,)
    times: Any = None
    fixed: bool = False

    @classmethod
    def of(cls, item: Any, where: str) -> _Element:
        if isinstance(item, h5py.Dataset):
            check_stored_size(item, where)
            return cls(item, fixed=True)
        check_stored_size(item["value"], where)

        def series(name: str) -> Any:
            stated = item.get(name)
            if not isinstance(stated, h5py.Dataset):
                return None
            numbers = np.asarray(stated[()])
            if numbers.ndim:
                return numbers
            rows = np.arange(*(item["value"].shape[:1] or (0,)))  # of even ones: their distance, and the first
            return float(stated.attrs.get("offset", 0)) + float(numbers) * rows

        return cls(item["value"], series("step"), series("time"))

    def step(self, index: int) -> int | None:
        """The step of a row."""
        return None if self.steps is None or index >= len(self.steps) else int(self.steps[index])

    def time(self, index: int) -> float | None:
        """The time of a row."""
        return None if self.times is None or index >= len(self.times) else float(self.times[index])

    def row(self, index: int) -> np.ndarray:
        """The values of a row; names of those that are enumerated."""
        names = {number: name for name, number in (h5py.check_enum_dtype(self.values.dtype) or {}).items()}
        row = np.asarray(self.values[()] if self.fixed else self.values[index])
        if names:
            return np.array([names.get(number, str(number)) for number in row.flat]).reshape(row.shape)
        return row

    def row_at(self, index: int, step: int | None) -> np.ndarray | None:
        """The values at a step, which is that of a row of the positions; None where there are none."""
        if self.fixed:
            return self.row(0)
        if step is not None and self.steps is not None and self.step(index) != step:
            rows = [row for row in range(len(self.values)) if self.step(row) == step]
            return self.row(rows[0]) if rows else None
        return self.row(index) if index < len(self.values) else None
