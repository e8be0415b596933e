"""Arrays of MATLAB's files: of v7.3, which are HDF5, and of older ones, which scipy reads in a child process.

Fields of structs are named `struct/field`, entries of cells `cell_0`, `cell_1`, …; axes of one are left out, as MATLAB
adds them to vectors and numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from nmpm._support.bounded_files import check_regular
from nmpm._support.isolated import call_isolated
from nmpm.data.convert.base import readable
from nmpm.data.convert.named_arrays import Arrays
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5


@contextmanager
def open_mat(path: Path) -> Iterator[Arrays]:
    """The arrays of a MATLAB file by name, while the context lasts.

    Raises:
        DataError: if it cannot be read, or takes content from other files.
    """
    check_regular(path)
    if not h5py.is_hdf5(path):
        yield call_isolated(read_mat, path)
        return
    with open_hdf5(path) as file:
        check_self_contained(file, path)
        yield {name: _AsInMatlab(item) for name, item in _datasets(file, "", f"{path}")}


def read_mat(path: str) -> dict[str, np.ndarray]:
    """The arrays of a file before v7.3, by name."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    errors = (MatReadError, zlib.error, TypeError, LookupError, ArithmeticError, NotImplementedError, RecursionError)
    with readable(path, "a MATLAB file", *errors):
        content = loadmat(path, simplify_cells=True)
        return dict(_flat("", {name: value for name, value in content.items() if not name.startswith("__")}))


def _flat(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}" if name else str(key), inner)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype.hasobject):
        for index, inner in enumerate(value):
            yield from _flat(f"{name}_{index}", inner)
    elif (array := np.asarray(value)).dtype.kind in "biufUS":
        yield name, array


@dataclass(frozen=True)
class _AsInMatlab:
    """A dataset with its axes as in MATLAB, which stores the last one first."""

    dataset: Any

    @property
    def shape(self) -> tuple[int, ...]:
        """Its size along each axis that is not one."""
        return tuple(size for size in reversed(self.dataset.shape) if size != 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The kind of its numbers."""
        kind: np.dtype[Any] = self.dataset.dtype
        return kind

    def __getitem__(self, rows: Any) -> np.ndarray:
        return np.asarray(np.asarray(self.dataset[()]).T.reshape(self.shape)[rows])


def _datasets(group: Any, prefix: str, where: str) -> Iterator[tuple[str, Any]]:
    """Datasets of numbers by path; cells refer to theirs in the group `#refs#`."""
    for name in group:
        item, path = group.get(name), f"{prefix}{name}"
        if (
            isinstance(item, h5py.Group)
            and not name.startswith("#")
            and not isinstance(group.get(name, getlink=True), h5py.SoftLink)
        ):
            yield from _datasets(item, f"{path}/", where)
        elif isinstance(item, h5py.Dataset) and item.shape is not None:
            check_stored_size(item, f"{where}: {path}")
            if item.dtype == h5py.ref_dtype:
                entries = (group.file[reference] for reference in item[()].T.flat if reference)
                inner = [(f"{path}_{index}", entry) for index, entry in enumerate(entries)]
            else:
                inner = [(path, item)]
            for inner_path, entry in inner:
                if isinstance(entry, h5py.Dataset) and entry.dtype.kind in "biuf" and not _is_text(entry):
                    check_stored_size(entry, f"{where}: {inner_path}")
                    yield inner_path, entry


def _is_text(dataset: Any) -> bool:
    return bool(dataset.attrs.get("MATLAB_class") == b"char")
