"""What is wrong with data of no known form: the nearest form, and how to get from here to there."""

from __future__ import annotations

import os
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from nmpm.data.convert.array_files import ArrayFiles, open_arrays
from nmpm.data.convert.named_arrays import Arrays, can_be_positions, describe, transposition, with_meaning
from nmpm.data.convert.tables import SUFFIXES, read_columns, table_columns
from nmpm.data.format import is_no_data
from nmpm.errors import NmpmError

_PAGE = "docs/howto/your_data.md shows all forms."
_MOST = 1000  # files that are looked at
_WRITE = 'nmpm.write_trajectories("mydata", runs, dt=…)'

HINTS: Mapping[str, str] = {
    suffix: hint
    for suffixes, hint in (
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
            ".bgeo .sc .abc .usd .usda .usdc .obj .vdb",
            "Houdini or Blender write it as a .ply file per frame, which are read; SPlisHSPlasH writes VTK where its"
            " scene says enableVTKExport, and its tool partio2vtk converts .bgeo",
        ),
        (
            ".bphys",
            "caches of Blender: let a script save each frame's particle locations by"
            ' np.save(f"run0/{frame:04}.npy", locations), (N, 3)',
        ),
        (
            ".bi4 .ibi4",
            "DualSPHysics's PartVTK writes them as VTK: PartVTK -dirdata data -savevtk particles/PartFluid"
            " -onlytype:-all,+fluid, and -savevtk particles/PartBound -onlytype:-all,+bound",
        ),
        (
            ".pvtp .pvtu .vtm .vtmb .vtr .vti .xdmf .xmf .xdmf3 .case .exo .e .ex2 .plt .szplt .silo .foam",
            "open it in ParaView, apply Merge Blocks or Extract Surface where it has parts, and File, Save Data as .vtp"
            " or .csv with all time steps",
        ),
        (
            ".odb",
            "Abaqus's own Python (abaqus python script.py, odbAccess) writes a .csv with frame, id, x, y, z of each"
            " particle or node",
        ),
        (".d3plot .rst .cas .sim .dem .rocky20 .rocky", f"export .csv, with frame or time, id, x, y, z; or {_WRITE}"),
        (".pcd .las .laz .e57", "CloudCompare or Open3D write it as a .ply file per frame, which are read"),
        (
            ".lammpsbin .bin",
            f"binary dumps of LAMMPS become text by its tool binary2txt; others you load yourself, then {_WRITE}",
        ),
        (".rds .rdata", "write it as .parquet or .csv: a row for each particle in each frame, with frame, id, x, y"),
    )
    for suffix in suffixes.split()
}
"""How to get from files of a suffix to a form that is read."""

_BY_NAME: Mapping[str, str] = {
    r"ptv_is\.\d+|rt_is\.\d+": (
        "OpenPTV's files: in Python, flowtracks.io.trajectories_ptvis('ptv_is.%d') reads them; write a .csv of the"
        " columns frame, id, x, y, z: trajectory.time(), trajectory.trajid(), trajectory.pos()"
    ),
    r"lagrangian/[^/]+/(positions|coordinates|U|origId)(\.gz)?": (
        "OpenFOAM's clouds: foamToVTK writes them as VTK: nmpm inspect CASE/VTK/lagrangian/CLOUD"
    ),
    r"[^/]+\.data(\.\d+)?": (
        f"where it is MercuryDPM's, its tool data2pvd writes a .pvd with its files, which are read; else {_WRITE}"
    ),
}
"""The same by names that have no suffix of their own."""

_PYSPH = (
    "Write HDF5: from pysph.solver.utils import dump, load; data = load(file); dump(file.replace('.npz', '.hdf5'),"
    " list(data['arrays'].values()), data['solver_data'])."
)
_UNPACK: Mapping[str, str] = {
    ".zip": "python -m zipfile -e {file} {folder}",
    **dict.fromkeys(
        (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz"),
        "mkdir -p {folder} && tar -xf {file} -C {folder}",
    ),
    ".7z": "7z x {file} -o{folder}",
    ".rar": "unrar x {file} {folder}/",
}
_DECOMPRESS: Mapping[str, str] = {".gz": "gunzip -k", ".bz2": "bunzip2 -k", ".xz": "unxz -k", ".zst": "unzstd"}


def _unpacking(path: Path, file: Path) -> str | None:
    """The commands that unpack an archive or a compressed file and read it; None for other files."""
    end = next((end for end in sorted(_UNPACK, key=len, reverse=True) if file.name.lower().endswith(end)), None)
    if end is not None:
        folder = file.with_name(file.name[: -len(end)])
        command = _UNPACK[end].format(file=shlex.quote(str(file)), folder=shlex.quote(str(folder)))
        data = path if path.is_dir() else folder
        others = " Unpack others beside it likewise." if path.is_dir() else ""
        return f"{file}: archives are not unpacked: {command} && nmpm inspect {shlex.quote(str(data))}.{others}"
    if (tool := _DECOMPRESS.get(file.suffix.lower())) is not None:
        data = path if path.is_dir() else file.with_suffix("")
        quoted = shlex.quote(str(file))
        return f"{file}: it is compressed: {tool} {quoted} && nmpm inspect {shlex.quote(str(data))}."
    return None


def describe_unknown(path: Path) -> str:
    """A sentence on a file or folder that no format recognises: what it is nearest to, and what is missing."""

    def inside() -> Iterator[Path]:
        for folder, inner, names in os.walk(path):
            inner[:] = sorted(name for name in inner if not is_no_data(name))
            yield from (Path(folder, name) for name in sorted(names) if not is_no_data(name))

    files = [path] if path.is_file() else list(islice(inside(), _MOST))
    if not files:
        return f"{path}: no known format; the folder is empty. {_PAGE}"
    suffix = Counter(file.suffix.lower() for file in files).most_common(1)[0][0]
    first = next(file for file in files if file.suffix.lower() == suffix)
    if (unpacking := _unpacking(path, first)) and not any(first.match(pattern) for pattern in SUFFIXES):
        return f"{unpacking} {_PAGE}"
    for file in files:
        for pattern, hint in _BY_NAME.items():
            if re.search(rf"/({pattern})$", file.absolute().as_posix()):
                return f"{file}: {hint}. {_PAGE}"
    if suffix in HINTS:
        return f"{first}: {suffix} files are not read: {HINTS[suffix]}. {_PAGE}"
    if any(first.match(pattern) for pattern in ArrayFiles.patterns):
        try:
            with open_arrays(first) as arrays:
                candidates = {name: array for name, array in arrays.items() if can_be_positions(array)}
                problem = f"which array are the positions? Call it position ({describe(candidates)})."
                problem = problem if len(candidates) > 1 else _wrong_positions(arrays, first.suffix)
        except NmpmError as error:
            problem = str(error).removeprefix(f"{first}: ")
        return f"{first}: {problem} {_PAGE}"
    if any(first.match(pattern) for pattern in SUFFIXES):
        try:
            table_columns(first)
            return f"{first}: a table with the columns {', '.join(read_columns(first))}. {_PAGE}"
        except NmpmError as error:
            wanted = "A table of tracks has a row for each particle in each frame: frame or time, id, x, y."
            return f"{error} {wanted} {_PAGE}"
    shown = ", ".join(str(file.relative_to(path)) for file in files[:8]) if path.is_dir() else "a file"
    return f"{path}: no known format; found {shown}. If you can load it in Python: {_WRITE}. {_PAGE}"


def describe_several(path: Path, datasets: Sequence[Path]) -> str:
    """A sentence on a folder that is no dataset, but has some in it, which are to be named."""
    names = ", ".join(folder.name for folder in datasets[:8])
    more = f" and {len(datasets) - 8} more" if len(datasets) > 8 else ""
    several = f"several datasets, {names}{more}" if len(datasets) > 1 else f"a dataset, {names}"
    return f"{path}: the folder is not one dataset but holds {several}: name one of them, e.g. {datasets[0]}."


def _wrong_positions(arrays: Arrays, suffix: str) -> str:
    """What is wrong with the shape of the array that is called positions, or else of the largest one."""
    if {"particles", "solver_data"} <= set(arrays):
        return f"PySPH's .npz holds Python objects, which are not unpickled. {_PYSPH}"
    leaves = {name.rpartition("/")[2]: name for name in reversed(list(arrays))}
    named = [leaves[leaf] for leaf in with_meaning("position", leaves)]
    numbers = [name for name, array in arrays.items() if array.dtype.kind in "fiuO"]
    largest = sorted(numbers, key=lambda name: -int(np.prod(arrays[name].shape)))
    name = next(iter(named or largest), None)
    if name is None:
        wanted = "positions are floats (T, N, D), or (R, T, N, D) of R runs: frames, particles, 1 to 3 axes"
        return f"no array can be positions ({describe(arrays)}); {wanted}."
    kind, shape = arrays[name].dtype, tuple(arrays[name].shape)
    if kind.hasobject:
        return f"{name!r} holds Python objects, which are not unpickled: save each run as run0, run1, … by np.savez."
    if kind.kind in "SU":
        return f"{name!r} holds texts; save numbers: .astype(float)."
    problem = f"{name!r} is {kind} of shape {shape}; positions are (T, N, D), or (R, T, N, D) of R runs"
    if (found := transposition(arrays[name])) is not None:
        order, axes = found
        leaf = name.split("/")[-1]
        matlab = f"in MATLAB permute({leaf}, {[axis + 1 for axis in order]}), or "
        way = f"{matlab if suffix == '.mat' else ''}np.transpose({leaf}, {order}) and {_WRITE}"
        return f"{problem}; its axes look like ({axes}): {way}."
    if len(shape) == 2 and shape[1] in (2, 3):
        return f"{problem}: this is one frame. Give the folder of the frames, or stack them: np.stack(frames)."
    return f"{problem}: frames, particles, 1 to 3 axes."
