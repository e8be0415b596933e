"""Rules that hold in every reader, whatever the form of the files."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nmpm._support.messages import install
from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split, Trajectory
from nmpm.errors import ConfigError
from tests.data.convert.writers import WRITERS, N, T, made


@pytest.fixture(params=WRITERS)
def write(request, tmp_path) -> Callable[..., Path]:
    def write(position: np.ndarray, **arrays: np.ndarray) -> Path:
        folder = tmp_path / "data"
        folder.mkdir()
        return WRITERS[request.param](folder / request.param, position, arrays)

    return write


def read(path: Path) -> Trajectory:
    return next(open_dataset(path).splits["train"]())


@pytest.mark.parametrize(("axis", "value"), [(0, 0.25), (1, -3.0), (2, 0.0), (2, 0.1)])
def test_a_constant_axis_makes_two_dimensions(write, axis, value):
    position = made()
    position[..., axis] = value
    dataset = open_dataset(write(position, **{f"v{name}": 2 * position[..., i] for i, name in enumerate("xyz")}))
    assert dataset.metadata.dim == 2
    assert [note for note in dataset.notes if f"{'xyz'[axis]} is {value:g} everywhere: 2-D data, of" in note]
    flat, run = np.delete(position, axis, axis=2), next(dataset.splits["train"]())
    np.testing.assert_allclose(run.position, flat, atol=1e-6)
    np.testing.assert_allclose(run.fields["velocity"], 2 * flat, atol=1e-6)


@pytest.mark.parametrize("name", ["valid", "mask"])
@pytest.mark.parametrize("kind", [bool, int])
def test_masks_are_absences(write, name, kind):
    position, there = made(), np.ones((T, N), bool)
    there[:4, 1] = there[7:, 3] = False
    position[~there] = 0
    run = read(write(position, **{name: there.astype(kind)}))
    np.testing.assert_array_equal(np.isnan(run.position).all(axis=2), ~there)
    np.testing.assert_allclose(run.position[there], position[there], atol=1e-6)
    assert name not in run.fields


def test_files_of_file_managers_and_archivers_are_no_data(write, tmp_path):
    path = write(made())
    run = read(path.parent)
    inside = path if path.is_dir() else path.parent
    first = next(inside.iterdir()) if path.is_dir() else path
    for name in (f"._{first.name}", f".{first.name}"):
        (first.parent / name).write_bytes(b"\0\5\x16\7 not data")
    (inside / "Thumbs.db").write_bytes(b"not data")
    for folder in ("__MACOSX", ".ipynb_checkpoints"):
        (inside / folder).mkdir()
        (inside / folder / first.name).write_bytes(b"not data")
    again = open_dataset(path.parent)
    assert list(again.splits) == ["train"]
    np.testing.assert_array_equal(next(again.splits["train"]()).position, run.position)


@pytest.mark.parametrize("shape", [(N, 1), (T, N, 1), (T, N), (N,)])
@pytest.mark.parametrize("name", ["run.npz", "run.h5", "npy"])
def test_types_and_masks_may_have_an_axis_of_one(tmp_path, name, shape):
    particles = shape[:-1] if shape[-1] == 1 else shape
    types = np.broadcast_to([3, 3, 4, 4, 5, 5], particles).reshape(shape)
    there, heat = np.ones(shape, bool), np.arange(float(np.prod(shape))).reshape(shape)
    arrays = {"types": types, "active": there, "heat": heat, "time": np.arange(T)[:, None] * 0.5}
    run = read(WRITERS[name](tmp_path / name, made(), arrays))
    assert run.particle_type.tolist() == [3, 3, 4, 4, 5, 5]
    np.testing.assert_array_equal(run.fields["heat"], heat.reshape(particles))
    np.testing.assert_array_equal(run.fields["time"], np.arange(T) * 0.5)


def test_particles_keep_their_ids_in_whatever_order_frames_have_them(write, tmp_path):
    rng, position, ids = np.random.default_rng(1), made(), np.array([70, 3, 51, 9, 12, 8])
    types, there = ids % 2 + 1, np.ones((T, N), bool)
    there[:5, 2] = there[8:, 0] = False  # one that appears late, one that leaves
    order = rng.permuted(np.tile(np.arange(N), (T, 1)), axis=1)
    at = np.arange(T)[:, None], order
    path = write(position[at], id=ids[order], type=types[order], active=there[at].astype(int))
    convert(path, tmp_path / "out")
    run = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    column = np.argsort(ids)
    assert run.ids()[0].tolist() == sorted(ids.tolist())
    assert run.particle_type.tolist() == types[column].tolist()
    expected = np.where(there[..., None], position, np.nan)[:, column]
    np.testing.assert_allclose(run.position, expected, atol=1e-6)


@pytest.mark.parametrize("name", ["tracks.csv", "run.npz"])
def test_ids_may_be_texts(tmp_path, name):
    ids = np.array([f"grain {letter}" for letter in "fcaebd"])
    run = read(WRITERS[name](tmp_path / name, made(), {"id": ids}))
    column = [run.ids("S")[0].tolist().index(label) for label in ids]
    np.testing.assert_allclose(run.position[:, column], made(), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, kind) for name in ("run.npz", "run.h5", "npy") for kind in ("M8[us]", "U32", "S32")),
        *((name, "U32") for name in ("tracks.csv", "tracks.parquet", "csv_frames")),
    ],
)
@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_dates_are_seconds_since_the_first(tmp_path, name, kind, zone):
    if kind == "M8[us]" and (zone or name == "run.h5"):
        return  # NumPy's dates have no zone, HDF5 has no dates
    moments = np.datetime64("2026-05-31T23:59:59.995", "ms") + np.arange(T)
    texts = [f"{moment}{zone}".replace("T", " ") for moment in moments]
    time = moments.astype(kind) if kind == "M8[us]" else np.array(texts, kind)
    time = time.astype(object) if name == "run.h5" and kind == "U32" else time
    in_rows = name in ("tracks.csv", "tracks.parquet", "csv_frames")
    stored = np.broadcast_to(time[:, None], (T, N)) if in_rows else time
    run = read(WRITERS[name](tmp_path / name, made(), {"time": stored}))
    np.testing.assert_allclose(run.fields["time"], np.arange(T) / 1000, atol=1e-12)
    np.testing.assert_allclose(run.position, made(), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "module", "package", "extra"),
    [
        ("vtk", "vtkmodules", "pyvista", "vtk"), ("ply", "plyfile", "plyfile", "vtk"), ("gsd", "gsd", "gsd", "gsd"),
        ("parquet", "pyarrow", "pyarrow", "tables"),
    ],
)  # fmt: skip
def test_a_missing_package_gives_the_install_command(tmp_path, monkeypatch, name, module, package, extra):
    path = tmp_path / f"run.{name}"
    path.write_bytes(b"any content")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=rf"run.{name}: reading \w+ needs {package}: {re.escape(install(extra))}\.$"):
        open_dataset(path)
