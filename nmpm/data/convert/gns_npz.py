"""The `.npz` files of geoelements/gns: per trajectory an array of objects, positions and particle types.

Members are named `simulation_trajectory_0` or `simulation_0`, and so on; each holds (positions (T, N, D), one type or
(N,) types) and in some datasets a material property, one or (N,). Newer files hold one member, `gns_data`, with a row
per trajectory. NumPy stores objects as a pickle, which is read by the restricted unpickler.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.convert.array_files import NpzArray, npz_members
from nmpm.data.convert.base import DescribedFiles, Facts, Options, Run, located
from nmpm.data.convert.pickles import load_pickled, number_array
from nmpm.data.format import METADATA_FILE, Metadata, Trajectory, read_metadata
from nmpm.errors import DataError

_ALL = "gns_data"


class GnsNpz(DescribedFiles):
    """NumPy files with a `metadata.json` beside them."""

    summary: ClassVar[str] = "NumPy files of geoelements/gns with metadata.json"
    patterns: tuple[str, ...] = ("*.npz",)

    def recognises(self, path: Path) -> bool:
        return super().recognises(path) and ((path if path.is_dir() else path.parent) / METADATA_FILE).is_file()

    def facts(self, file: Path, options: Options) -> Facts:
        return Facts(read_metadata(file.parent, options.family or self.family), has_family=True)

    def runs(self, file: Path) -> Sequence[Run]:
        return [Run(file, index) for index in range(sum(count for _, _, count in _members(file)))]

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        for array, where, count in _members(file):
            content: Any = load_pickled(array.pickled(), where) if array.dtype.hasobject else array[()]
            rows = [content] if where != f"{file}: {_ALL}" else list(content) if getattr(content, "ndim", 0) else []
            if len(rows) != count:
                raise DataError(f"{where}: its header states {count} trajectories; it holds {len(rows)}.")
            for row in rows:
                yield _trajectory(row, where)


def _members(file: Path) -> Iterator[tuple[NpzArray, str, int]]:
    """Yields each member, where it is, and its number of trajectories."""
    names = npz_members(file)
    with zipfile.ZipFile(file) as archive:
        for name in names:
            where = f"{file}: {one_line(name, 60)}"
            array = NpzArray(archive, name, where)
            yield array, where, (*array.shape, 0)[0] if name == _ALL else 1


def _trajectory(row: Any, where: str) -> Trajectory:
    parts: list[Any] = [*row] if isinstance(row, np.ndarray | list | tuple) else []
    if len(parts) not in (2, 3):
        raise DataError(
            f"{where}: expected (positions, types) or (positions, types, property); found {len(parts)} parts."
        )
    position = number_array(parts[0], f"{where}: positions")
    if position.ndim != 3:
        raise DataError(f"{where}: positions must have the shape (T, N, D); they have {position.shape}.")
    types = _per_particle(parts[1], position.shape[1], f"{where}: types").astype(np.int64)
    fields = {}
    if len(parts) == 3:
        fields["material_property"] = _per_particle(parts[2], position.shape[1], f"{where}: material property")
    with located(where):
        return Trajectory(position.astype(np.float32), types, {}, fields)


def _per_particle(value: Any, particles: int, where: str) -> np.ndarray:
    """(N,) numbers, from one per particle or one for all."""
    numbers = number_array(value, where)
    if numbers.size not in (1, particles) or numbers.ndim > 1:
        raise DataError(
            f"{where}: expected one number, or one for each of {particles} particles; found shape {numbers.shape}."
        )
    return np.broadcast_to(numbers.reshape(-1), particles).copy()
