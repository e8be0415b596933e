"""Every reader reads thousands of damaged files, or refuses them by typed errors of one line (`pytest -m slow`)."""

import io
import json
import pickle
import random
import shutil
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io

from nmpm.data.convert import Options, open_dataset
from nmpm.data.format import Split, read_metadata, write_metadata
from nmpm.data.hdf5 import FILTERS
from nmpm.data.loading.sources import FolderSource
from nmpm.errors import NmpmError
from tests.data.convert import records
from tests.data.convert.test_gns_npz import pair
from tests.data.convert.test_rollout_pickle import rollout
from tests.data.fuzzing import damage, random_changes

dmcf = pytest.importorskip("tests.data.convert.test_dmcf", reason="the extra `convert` is not installed")
TRIES = 500
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
