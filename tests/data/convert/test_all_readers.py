"""Rules that hold in every reader, whatever the form of the files."""

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm._support.messages import install
from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split, Trajectory
from nmpm.errors import ConfigError

T, N = 12, 6
Arrays = Mapping[str, np.ndarray]


def made(frames: int = T, particles: int = N) -> np.ndarray:
    """Positions (T, N, 3) with six decimals."""
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(0, 1e-3, (frames, particles, 3)), axis=0)
    return (rng.uniform(0.2, 0.8, (1, particles, 3)) + walk).round(6)


def columns_of(position: np.ndarray, arrays: Arrays) -> dict[str, np.ndarray]:
    """(T, N) columns."""
    sizes = position.shape[:2]
    coordinates = {axis: position[..., number] for number, axis in enumerate("xyz")}
    return coordinates | {name: np.broadcast_to(values, sizes) for name, values in arrays.items()}


def rows(columns: Mapping[str, np.ndarray], separator: str, first: int = 0) -> str:
    return "\n".join(separator.join(map(str, row)) for row in zip(*columns.values(), strict=True)) + "\n"


def write_tracks(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    sizes, separator = position.shape[:2], "\t" if path.suffix == ".tsv" else ","
    frame, particle = np.mgrid[: sizes[0], : sizes[1]]
    columns = columns_of(position, {"frame": frame, **({} if "id" in arrays else {"particle": particle}), **arrays})
    path.write_text(separator.join(columns) + "\n" + rows({n: v.reshape(-1) for n, v in columns.items()}, separator))
    return path


def write_parquet(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    tables = pytest.importorskip("pyarrow.csv"), pytest.importorskip("pyarrow.parquet")
    tables[1].write_table(tables[0].read_csv(write_tracks(path.with_suffix(".csv"), position, arrays)), path)
    path.with_suffix(".csv").unlink()
    return path


def write_csv_frames(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    path.mkdir()
    columns = columns_of(position, arrays)
    for frame in range(len(position)):
        text = rows({name: values[frame] for name, values in columns.items()}, ",")
        (path / f"frame_{frame:03d}.csv").write_text(",".join(columns) + "\n" + text)
    return path


def write_npz(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    np.savez(path, position=position, **arrays)
    return path


def write_npy(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    path.mkdir()
    for name, values in {"position": position, "time": np.arange(len(position)), **arrays}.items():
        np.save(path / f"{name}.npy", values)
    return path


def write_hdf5(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in {"position": position, **arrays}.items():
            file[name] = values
    return path


def write_vtkhdf(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    frames, particles = position.shape[:2]
    first = np.arange(frames) * particles
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Type"] = np.bytes_("PolyData")
        root["Points"] = np.pad(position, ((0, 0), (0, 0), (0, 3 - position.shape[2]))).reshape(-1, 3)
        root["NumberOfPoints"] = np.full(frames, particles)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"], steps["PartOffsets"], steps["PointOffsets"] = np.arange(frames) * 0.5, range(frames), first
        for name, values in arrays.items():
            root[f"PointData/{name}"] = np.broadcast_to(values, position.shape[:2]).reshape(-1)
            steps[f"PointDataOffsets/{name}"] = first
    return path


def write_xyz(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    kinds = {"i": "I", "b": "L", "f": "R", "U": "S"}
    properties = f"pos:R:{position.shape[2]}" + "".join(f":{n}:{kinds[v.dtype.kind]}:1" for n, v in arrays.items())
    columns, text = columns_of(position, arrays), ""
    for frame in range(len(position)):
        inside = {name: values[frame] for name, values in columns.items()}
        inside |= {n: np.where(v, "T", "F") for n, v in inside.items() if v.dtype == bool}  # as ASE writes them
        text += f"{position.shape[1]}\nProperties={properties}\n" + rows(inside, " ")
    path.write_text(text)
    return path


def write_lammps(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    text, columns = "", columns_of(position, {n: v.astype(int) if v.dtype == bool else v for n, v in arrays.items()})
    for frame in range(len(position)):
        text += f"ITEM: TIMESTEP\n{frame}\nITEM: NUMBER OF ATOMS\n{position.shape[1]}\n"
        text += (
            f"ITEM: BOX BOUNDS ff ff ff\n{'-9 9' + chr(10)}{'-9 9' + chr(10)}-9 9\nITEM: ATOMS {' '.join(columns)}\n"
        )
        text += rows({name: values[frame] for name, values in columns.items()}, " ")
    path.write_text(text)
    return path


def write_vtk(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    pyvista = pytest.importorskip("pyvista")
    path.mkdir()
    for frame, points in enumerate(np.pad(position, ((0, 0), (0, 0), (0, 3 - position.shape[2])))):
        cloud = pyvista.PolyData(points)
        for name, values in arrays.items():
            cloud[name] = np.broadcast_to(values, position.shape[:2])[frame]
        cloud.save(path / f"frame_{frame:03d}{path.suffix}")
    return path


def write_ply(path: Path, position: np.ndarray, arrays: Arrays) -> Path:
    pytest.importorskip("plyfile")
    path.mkdir()
    columns = columns_of(position, {n: v.astype(int) if v.dtype == bool else v for n, v in arrays.items()})
    kinds = {name: "int" if values.dtype.kind == "i" else "double" for name, values in columns.items()}
    declared = "\n".join(f"property {kind} {name}" for name, kind in kinds.items())
    for frame in range(len(position)):
        head = f"ply\nformat ascii 1.0\nelement vertex {position.shape[1]}\n{declared}\nend_header\n"
        text = rows({name: values[frame] for name, values in columns.items()}, " ")
        (path / f"frame_{frame:03d}.ply").write_text(head + text)
    return path


WRITERS: dict[str, Callable[[Path, np.ndarray, Arrays], Path]] = {
    "tracks.csv": write_tracks, "tracks.tsv": write_tracks, "tracks.parquet": write_parquet,
    "csv_frames": write_csv_frames, "run.npz": write_npz, "npy": write_npy, "run.h5": write_hdf5,
    "run.vtkhdf": write_vtkhdf, "run.xyz": write_xyz, "run.lammpstrj": write_lammps, "run.vtk": write_vtk,
    "run.vtp": write_vtk, "run.ply": write_ply,
}  # fmt: skip


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
    dataset = open_dataset(write(position))
    assert dataset.metadata.dim == 2
    assert [note for note in dataset.notes if f"{'xyz'[axis]} is {value:g} everywhere: 2-D data, of" in note]
    flat = np.delete(position, axis, axis=2)
    np.testing.assert_allclose(next(dataset.splits["train"]()).position, flat, atol=1e-6)


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
