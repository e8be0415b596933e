"""Every reader reads thousands of damaged files, or refuses them by typed errors of one line (`pytest -m slow`).

Readers of folders and of foreign parsers do so in a process of their own, whose end and memory are watched.
"""

import gzip
import io
import json
import pickle
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from nmpm.data.convert import READERS, Options, open_dataset
from nmpm.data.format import Split, read_metadata, write_metadata
from nmpm.data.hdf5 import FILTERS
from nmpm.data.sources import FolderSource
from nmpm.errors import NmpmError
from tests.data.convert import records
from tests.data.convert.test_pickles import pair, rollout
from tests.data.fuzzing import damage, random_changes

ROOT = Path(__file__).parents[2]
MEMORY = 2**30

dmcf = pytest.importorskip("tests.data.convert.test_dmcf", reason="the extra `convert` is not installed")
TRIES, FOLDER_TRIES = 500, 100
METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 6, "dim": 2, "dt": 0.0025, "gravity": [0, -9.81],
            "particle_types": {"3": "boundary", "5": "water"}, "static_types": [3], "domain": [[0, 1], [0.1, 0.9]],
            "periodic_boundary_conditions": [False, True], "densities": {"water": 1000.0}, "vel_std": [1e-3, 1e-3],
            "particle_volume": 1e-4, "write_every": 1}  # fmt: skip
POSITION, TYPES = records.made(6, 5)


def hdf5(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w", libver=("earliest", "v108")) as opened:
        for name, values in arrays.items():
            chunks = {"chunks": (2, *values.shape[1:]), **FILTERS} if values.ndim == 3 else {}
            opened.create_dataset(name, data=values, **chunks)
        for group in (opened[name] for name in opened if isinstance(opened[name], h5py.Group)):
            group.attrs["gravity"], group.attrs["seed"] = [0.0, -9.81], 3
    return file.getvalue()


def npy() -> bytes:
    file = io.BytesIO()
    np.save(file, pair(POSITION, TYPES), allow_pickle=True)
    return file.getvalue()


def zipped(member: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("simulation_0.npy", member)
    return file.getvalue()


def compressed(content: bytes) -> bytes:
    return dmcf.zstandard.ZstdCompressor().compress(content)


def pickled(protocol: int) -> bytes:
    metadata = METADATA | {"vel_std": np.array([1e-3, 1e-3])}
    return pickle.dumps(rollout(particle_types=np.array([5, 5, 5, 3]), metadata=metadata), protocol)


NATIVE = hdf5(
    {f"0000{i}/{key}": values for i in range(2) for key, values in
     (("position", POSITION), ("particle_type", TYPES), ("heat", np.ones((6, 5))))}
)  # fmt: skip
NEURALMPM = hdf5({"particles": POSITION, "boundary": POSITION[:, :3], "types": TYPES, "grav": np.array([0.0, -9.81])})
MATLAB = io.BytesIO()
scipy.io.savemat(MATLAB, {"run": {"position": POSITION, "types": TYPES}, "dt": 0.0025}, do_compression=True)
RECORD = records.trajectory_record(POSITION, TYPES, step_context=np.ones((6, 3)))
MESSAGES = dmcf.msgpack.packb(dmcf.frames())
FRAMES = hdf5({f"frame_{t}/{key}": POSITION[t] for t in range(6) for key in ("position", "velocity")})
ROWS = {"position": POSITION, "species": np.tile(TYPES, (6, 1))}
STEPS = {"step": np.arange(6), "time": np.arange(6) * 0.5}
H5MD = hdf5(
    {f"particles/all/{name}/{key}": values for name, rows in ROWS.items()
     for key, values in ({"value": rows} | STEPS).items()}
)  # fmt: skip
TECPLOT = 'VARIABLES = "x", "y", "id"\n' + "".join(
    f"ZONE SOLUTIONTIME={t}\n" + "".join(f"{x} {y} {i}\n" for i, (x, y) in enumerate(POSITION[t].tolist()))
    for t in range(6)
)
FORMATS = {
    "native": ("train.h5", NATIVE, bytes),
    "metadata": ("metadata.json", json.dumps(METADATA).encode(), bytes),
    "deepmind": ("train.tfrecord", RECORD, bytes),
    "deepmind inside": ("train.tfrecord", RECORD[12:-4], records.record),
    "gns-npz": ("train.npz", zipped(npy()), bytes),
    "gns-npz inside": ("train.npz", npy(), zipped),
    "neuralmpm": ("train/sim_0.h5", NEURALMPM, bytes),
    "mat": ("train/a.mat", MATLAB.getvalue(), bytes),
    "dmcf": ("train/a.msgpack.zst", compressed(MESSAGES), bytes),
    "dmcf inside": ("train/a.msgpack.zst", MESSAGES, compressed),
    "rollout-pickle": ("rollout_0.pkl", pickled(4), bytes),
    "rollout-pickle 2": ("rollout_0.pkl", pickled(2), bytes),
    "array-frames": ("run.h5", FRAMES, bytes),
    "h5md": ("run.h5", H5MD, bytes),
    "tecplot": ("run.dat", TECPLOT.encode(), bytes),
}
"""The file, its valid content or what is inside of it, and what puts that into compression and checksums."""


def read(folder, file: str, content: bytes) -> None:
    """Read all of a dataset with this content of its file."""
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(METADATA))
    (folder / file).write_bytes(content)
    if file == "metadata.json":
        metadata = read_metadata(folder)
        write_metadata(folder, metadata)
        assert read_metadata(folder) == metadata
        (folder / "train.h5").write_bytes(NATIVE)
        assert FolderSource(folder).scene.dim == metadata.dim
    elif file == "train.h5":
        split = Split(folder / file)
        for index in range(len(split)):
            split.read_with_fields(index)
        assert all(recording.frames.isfinite().all() for recording in FolderSource(folder).recordings("train"))
    else:
        for start in open_dataset(folder, None, Options(types={5: "water"}, dt=0.0025)).splits.values():
            assert not any(np.isinf(trajectory.position).any() for trajectory in start())


@pytest.mark.parametrize("name", FORMATS)
def test_valid_files_are_read(name, tmp_path):
    file, content, wrap = FORMATS[name]
    read(tmp_path, file, wrap(content))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_give_typed_errors(name, tmp_path):
    (file, content, wrap), errors = FORMATS[name], list[str]()
    for seed in range(TRIES):
        changes = random_changes(random.Random(f"{name} {seed}"))
        try:
            read(tmp_path / "data", file, wrap(damage(content, changes)))
        except NmpmError as error:
            errors.append(str(error))
        shutil.rmtree(tmp_path / "data")
    assert len(errors) > TRIES // 5
    assert not [error for error in errors if "\n" in error]


# Folders of files, by functions that write them.

FRAMES, COUNT = 6, 5
RUN = np.random.default_rng(1).random((FRAMES, COUNT, 3)).astype("f4")
ROWS = [(t, i, *(f"{value:.6f}" for value in RUN[t, i])) for t in range(FRAMES) for i in range(COUNT)]


def per_frame(suffix, write):
    def write_all(folder):
        for t in range(FRAMES):
            write(folder / f"frame_{t}{suffix}", t)

    return write_all


def mesh(binary, grid=False):
    def write(path, t):
        pyvista = pytest.importorskip("pyvista", reason="the extra `vtk` is not installed")
        points = pyvista.PolyData(RUN[t])
        points.point_data["velocity"], points.point_data["id"] = 2 * RUN[t], np.arange(COUNT)
        points.field_data["TimeValue"] = [0.5 * t]
        (points.cast_to_unstructured_grid() if grid else points).save(path, binary=binary)

    return write


def listed(name, text):
    def write(folder):
        per_frame(".vtp", mesh(False))(folder)
        (folder / name).write_text(text)

    return write


PVD = "".join(f'<DataSet timestep="{t}" part="0" file="frame_{t}.vtp"/>' for t in range(FRAMES))
SERIES = {"file-series-version": "1.0", "files": [{"name": f"frame_{t}.vtp", "time": t} for t in range(FRAMES)]}


def ply(text):
    def write(path, t):
        plyfile = pytest.importorskip("plyfile", reason="the extra `vtk` is not installed")
        columns = {"x": RUN[t, :, 0], "y": RUN[t, :, 1], "z": RUN[t, :, 2], "id": np.arange(COUNT, dtype="i4")}
        rows = np.array(list(zip(*columns.values(), strict=True)), [(n, c.dtype.str) for n, c in columns.items()])
        plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], text=text).write(path)

    return write


def text_file(name, text):
    def write(folder):
        content = text.encode()
        (folder / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)

    return write


def table(names, rows, delimiter=","):
    return "\n".join(delimiter.join(map(str, row)) for row in (names, *rows)) + "\n"


def parquet(folder):
    arrow = pytest.importorskip("pyarrow.parquet", reason="the extra `tables` is not installed")
    columns = dict(zip(("frame", "id", "x", "y", "z"), np.array(ROWS, float).T, strict=True))
    arrow.write_table(__import__("pyarrow").table(columns), folder / "tracks.parquet")


def gsd(folder):
    from tests.data.convert.test_gsd import write

    write(folder / "run.gsd", [2, 2, 2, 0, 0, 0])


def h5md(folder):
    from tests.data.convert.test_hdf5_frames import RUN as POSITIONS
    from tests.data.convert.test_hdf5_frames import STEPS, write

    write(folder / "run.h5md", {"all": {"position": (POSITIONS, STEPS), "id": np.arange(POSITIONS.shape[1])}})


def vtkhdf(folder):
    from tests.data.convert.test_hostile_files import write_vtkhdf

    write_vtkhdf(folder / "run.vtkhdf", lambda root: None)


XYZ = "".join(
    f'{COUNT}\nProperties="species:S:1:pos:R:3" Time={t} Lattice="1 0 0 0 1 0 0 0 1" pbc="T F F"\n'
    + table((), [("a", *row[2:]) for row in ROWS if row[0] == t], " ")[1:]
    for t in range(FRAMES)
)
LAMMPS = "".join(
    f"ITEM: TIMESTEP\n{10 * t}\nITEM: NUMBER OF ATOMS\n{COUNT}\nITEM: BOX BOUNDS pp ff ff\n0 1\n0 1\n0 1\n"
    + table(("ITEM: ATOMS id x y z",), [row[1:] for row in ROWS if row[0] == t], " ")
    for t in range(FRAMES)
)
TECPLOT = 'TITLE = "run"\nVARIABLES = "x" "y" "z"\n' + "".join(
    f'ZONE T="{t}", I={COUNT}, SOLUTIONTIME={t}\n' + table((), [row[2:] for row in ROWS if row[0] == t], " ")[1:]
    for t in range(FRAMES)
)
ARRAYS = {"positions": RUN, "types": np.arange(COUNT) % 2, "dt": np.array(0.1), "names": np.array(["a", "b"])}
NUMBERS = {f"run0/{name}": values for name, values in ARRAYS.items() if values.dtype.kind != "U"}
FOLDERS = {
    "vtk": per_frame(".vtk", mesh(False)),
    "vtk binary": per_frame(".vtk", mesh(True)),
    "vtp": per_frame(".vtp", mesh(False)),
    "vtp binary": per_frame(".vtp", mesh(True)),
    "vtu": per_frame(".vtu", mesh(True, grid=True)),
    "pvd": listed("run.pvd", f'<VTKFile type="Collection"><Collection>{PVD}</Collection></VTKFile>'),
    "series": listed("run.vtp.series", json.dumps(SERIES)),
    "vtkhdf": vtkhdf,
    "ply": per_frame(".ply", ply(True)),
    "ply binary": per_frame(".ply", ply(False)),
    "xyz": text_file("run.xyz", XYZ),
    "xyz gzipped": text_file("run.xyz.gz", XYZ),
    "lammps": text_file("run.lammpstrj", LAMMPS),
    "tecplot": text_file("run.dat", TECPLOT),
    "tracks": text_file("tracks.csv", table(("frame", "id", "x", "y", "z"), ROWS)),
    "tracks parquet": parquet,
    "csv-frames": per_frame(
        ".csv", lambda path, t: path.write_text(table("xyz", [row[2:] for row in ROWS if row[0] == t]))
    ),
    "arrays": lambda folder: np.savez_compressed(folder / "run.npz", **ARRAYS),
    "arrays npy": lambda folder: np.save(folder / "run.npy", RUN),
    "arrays h5": lambda folder: (folder / "run.h5").write_bytes(hdf5(NUMBERS)),
    "array-frames": per_frame(".npy", lambda path, t: np.save(path, RUN[t])),
    "h5md": h5md,
    "gsd": gsd,
}  # fmt: skip


def test_every_reader_is_fuzzed():
    fuzzed = {name.split()[0] for name in (*FORMATS, *FOLDERS)}
    assert {*READERS} - {"native-files"} <= fuzzed


def read_folder(folder):
    for start in open_dataset(folder, None, Options(dt=0.1)).splits.values():
        for trajectory in start():
            assert not np.isinf(trajectory.position).any()


def damaged_folders(name, tries, first=0):
    """Reads damaged copies of a folder; the errors, and other exceptions with the number of the damage."""
    errors, faults = [], []
    with tempfile.TemporaryDirectory() as place:
        valid, copy = Path(place, "valid"), Path(place, "copy")
        valid.mkdir()
        FOLDERS[name](valid)
        read_folder(valid)
        for seed in range(first, first + tries):
            rng = random.Random(f"{name} {seed}")
            shutil.copytree(valid, copy)
            file = rng.choice(sorted(copy.iterdir()))
            file.write_bytes(damage(file.read_bytes(), random_changes(rng)))
            try:
                read_folder(copy)
            except NmpmError as error:
                errors.append(str(error))
            except Exception as error:
                faults.append(f"{name} {seed}: {type(error).__name__}: {error}")
            shutil.rmtree(copy)
    return errors, faults


def in_a_process(names, tries):
    """What `damaged_folders` returns for the names, in a process that must not end or take much memory."""
    code = (
        "import json, sys, warnings, logging; warnings.simplefilter('ignore'); logging.disable()\n"
        "from tests.data import test_fuzz as fuzz\n"
        "before = fuzz.peak_memory(); names, tries = json.loads(sys.argv[1])\n"
        "found = [fuzz.damaged_folders(name, tries) for name in names]\n"
        "print(json.dumps([found, fuzz.peak_memory() - before]))"
    )
    words = [sys.executable, "-c", code, json.dumps([names, tries])]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    found, memory = json.loads(done.stdout.splitlines()[-1])
    assert memory < MEMORY
    return [error for errors, _ in found for error in errors], [fault for _, faults in found for fault in faults]


def peak_memory():
    """Bytes of this process, or of a child if that took more."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return 1024 * max(resource.getrusage(one).ru_maxrss for one in who)


def test_some_damaged_folders_give_typed_errors():
    for module in ("pyvista", "plyfile", "pyarrow", "gsd"):
        pytest.importorskip(module, reason="an extra is not installed")
    errors, faults = in_a_process(list(FOLDERS), 3)
    assert not faults
    assert len(errors) > 10
    assert not [error for error in errors if "\n" in error]


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDERS)
def test_damaged_folders_give_typed_errors(name):
    errors, faults = in_a_process([name], FOLDER_TRIES)
    assert not faults
    assert len(errors) > FOLDER_TRIES // 20
    assert not [error for error in errors if "\n" in error]
