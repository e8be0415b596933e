"""What is wrong with data of no known form: the nearest form, and how to get from here to there."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from nmpm.data.convert.array_files import ArrayFiles, open_arrays
from nmpm.data.convert.named_arrays import Arrays, can_be_positions, describe, with_meaning
from nmpm.data.convert.tables import SUFFIXES
from nmpm.data.convert.tracks import table_columns
from nmpm.data.split_files import SPLITS, is_no_data
from nmpm.errors import NmpmError

_PAGE = "docs/howto/your_data.md shows all forms."
_MOST = 1000  # files that are looked at
_WRITE = 'nmpm.write_trajectories("mydata", runs, dt=…)'

HINTS: Mapping[str, str] = {
    suffix: hint
    for suffixes, hint in (
        (".mat", f"read it by scipy.io.loadmat (or h5py) and write positions (T, N, D) by {_WRITE}"),
        (".pt .pth", f"read it by torch.load(…, weights_only=True) and write positions (T, N, D) by {_WRITE}"),
        (
            ".pkl .pickle",
            f"pickles of this content are not opened, as they can run code: load it yourself, then {_WRITE}",
        ),
        (".nc", f"read it by xarray.open_dataset and write positions (T, N, D) by {_WRITE}"),
        (".zarr", f"read it by zarr.open and write positions (T, N, D) by {_WRITE}"),
        (".xlsx", "save it as .csv: a row for each particle in each frame, with frame, id, x, y"),
        (".feather", "write it as .parquet: a row for each particle in each frame, with frame, id, x, y"),
        (".xtc .trr .dcd .pdb", "MDAnalysis, ase or OVITO write it as .xyz or as a LAMMPS dump, which are read"),
        (
            ".bgeo .sc .abc .usd .usda .usdc .obj",
            "Houdini or Blender write it as a .ply file per frame, which are read",
        ),
    )
    for suffix in suffixes.split()
}
"""How to get from files of a suffix to a form that is read."""


def describe_unknown(path: Path) -> str:
    """A sentence on a file or folder that no format recognises: what it is nearest to, and what is missing."""
    files = list(islice(_files(path), _MOST))
    if not files:
        return f"{path}: no known format; the folder is empty. {_PAGE}"
    suffix = Counter(file.suffix.lower() for file in files).most_common(1)[0][0]
    first = next(file for file in files if file.suffix.lower() == suffix)
    if suffix in HINTS:
        return f"{first}: {suffix} files are not read: {HINTS[suffix]}. {_PAGE}"
    if any(first.match(pattern) for pattern in ArrayFiles.patterns):
        return f"{first}: {_array_problem(first)} {_PAGE}"
    if any(first.match(pattern) for pattern in SUFFIXES):
        return f"{_table_problem(first)} {_PAGE}"
    shown = ", ".join(str(file.relative_to(path)) for file in files[:8]) if path.is_dir() else "a file"
    return f"{path}: no known format; found {shown}. If you can load it in Python: {_WRITE}. {_PAGE}"


def describe_several(path: Path, datasets: Sequence[Path]) -> str:
    """A sentence on a folder that is no dataset, but has some in it, which are to be named."""
    names = ", ".join(folder.name for folder in datasets[:8])
    more = f" and {len(datasets) - 8} more" if len(datasets) > 8 else ""
    several = f"several datasets, {names}{more}" if len(datasets) > 1 else f"a dataset, {names}"
    return f"{path}: the folder is not one dataset but holds {several}: name one of them, e.g. {datasets[0]}."


def subfolders(path: Path) -> Iterator[Path]:
    """The folders in a folder, in the order of their names; none in a file."""
    inside = sorted(path.glob("*")) if path.is_dir() else ()
    return (inner for inner in inside if inner.is_dir() and not is_no_data(inner.name))


def has_splits(folder: Path) -> bool:
    """Whether a folder has files or folders called train, valid or test, and is a dataset of its own."""
    return folder.name not in SPLITS and any(inner.name.split(".")[0] in SPLITS for inner in folder.glob("*"))


def _files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    for folder, inner, names in os.walk(path):
        inner[:] = sorted(name for name in inner if not is_no_data(name))
        yield from (Path(folder, name) for name in sorted(names) if not is_no_data(name))


def _array_problem(file: Path) -> str:
    """What is wrong with the arrays of a file, and what is wanted."""
    wanted = "positions are floats (T, N, D), or (R, T, N, D) of R runs: frames, particles, 1 to 3 axes"
    try:
        with open_arrays(file) as arrays:
            candidates = {name: array for name, array in arrays.items() if can_be_positions(array)}
            if len(candidates) > 1:
                return f"which array are the positions? Call it position ({describe(candidates)})."
            return _wrong_positions(arrays) or f"no array can be positions ({describe(arrays)}); {wanted}."
    except NmpmError as error:
        return str(error).removeprefix(f"{file}: ")


def _wrong_positions(arrays: Arrays) -> str | None:
    """What is wrong with the shape of the array that is called positions, or else of the largest one."""
    leaves = {name.rpartition("/")[2]: name for name in reversed(list(arrays))}
    named = [leaves[leaf] for leaf in with_meaning("position", leaves)]
    numbers = [name for name, array in arrays.items() if array.dtype.kind in "fiuO"]
    largest = sorted(numbers, key=lambda name: -int(np.prod(arrays[name].shape)))
    for name in (named or largest)[:1]:
        kind, shape = arrays[name].dtype, tuple(arrays[name].shape)
        problem = f"{name!r} is {kind} of shape {shape}; positions are (T, N, D), or (R, T, N, D) of R runs"
        small = [axis for axis, size in enumerate(shape) if size in (2, 3)]
        if kind.hasobject:
            return (
                f"{name!r} holds Python objects, which are not unpickled: save each run as run0, run1, … by np.savez."
            )
        if len(shape) in (3, 4) and small:
            return f"{problem}, the axes of space last: np.moveaxis({name.split('/')[-1]}, {small[-1]}, -1)."
        if len(shape) == 2 and shape[1] in (2, 3):
            return f"{problem}: this is one frame. Give the folder of the frames, or stack them: np.stack(frames)."
        return f"{problem}: frames, particles, 1 to 3 axes."
    return None


def _table_problem(file: Path) -> str:
    try:
        return f"{file}: a table with the columns {', '.join(table_columns(file).names)}."
    except NmpmError as error:
        return f"{error} A table of tracks has a row for each particle in each frame: frame or time, id, x, y."
