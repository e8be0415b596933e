"""Runs as files of each form have them: positions (T, N, D), and arrays (N,) or (T, N) by name."""

from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

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
