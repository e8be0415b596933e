"""NeuralMPM's datasets: a folder per split, a file `sim_*.h5` per trajectory.

Each file holds `particles` (T, N, D), `boundary` (T, M, D) and, where there are several materials, `types` (N,) or
(M + N,), the boundary's first; anything else, such as `grav`, is per trajectory. The files state neither
the time between frames nor the walls: for the published datasets (Rochman-Sharabi, Lewin, Louppe, 2025) a table does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from nmpm.data.convert.base import UNKNOWN_LENGTH, DatasetFormat, ForeignDataset, Options, Rereadable
from nmpm.data.families import find_family
from nmpm.data.format import SPLITS, Metadata, Trajectory
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5
from nmpm.data.statistics import first_moving_particle
from nmpm.errors import DataError
from nmpm.scene import Interval

_BOUNDARY = 3
_GRAVITY = "grav"


@dataclass(frozen=True)
class _Published:
    """Facts about a published dataset: its only material (None: the files have types), box, seconds between frames."""

    material: int | None
    domain: tuple[Interval, ...]
    dt: float
    gravity: tuple[float, ...] | None


_UNIT = ((0.08, 0.92), (0.08, 0.92))
_DOWN = (0.0, -9.81)
_PUBLISHED = {
    "waterramps": _Published(5, _UNIT, 0.0025, _DOWN),
    "sandramps": _Published(6, _UNIT, 0.0025, _DOWN),
    "goop": _Published(7, _UNIT, 0.0025, _DOWN),
    "multimaterial": _Published(None, _UNIT, 0.0025, _DOWN),
    "waterdrop": _Published(5, _UNIT, 0.0025, _DOWN),
    "waterdrop-xl": _Published(5, ((0.04, 0.97),) * 2, 0.0025, _DOWN),
    "dambreak2d": _Published(5, ((0.05, 5.44), (0.05, 2.07)), 0.03, (0.0, -1.0)),
    "variablegravity": _Published(5, ((-0.0025, 1.0025),) * 2, 0.0025, None),
}


class NeuralMpm(DatasetFormat):
    """A folder with folders train, valid and test of `sim_*.h5` files, or one of these."""

    name: ClassVar[str] = "neuralmpm"
    summary: ClassVar[str] = "NeuralMPM's folders of sim_*.h5 files, also from the hub's iSach/NeuralMPM"

    def recognises(self, path: Path) -> bool:
        return bool(_files(path))

    def open(self, path: Path, options: Options) -> ForeignDataset:
        files = _files(path)
        if not files:
            raise DataError(f"{path}: no train, valid or test folder with sim_*.h5 files there.")
        published = _PUBLISHED.get(path.resolve().name.lower())
        first = next(_trajectories(next(iter(files.values()))[:1], published.material if published else None))
        metadata = options.apply_to(_metadata(path, published, first, options))
        material = published.material if published else _only_material(options, path, files)
        family = options.family or "deepmind"
        return ForeignDataset(
            metadata=metadata,
            splits={split: Rereadable(partial(_trajectories, paths, material)) for split, paths in files.items()},
            notes=(*_notes(path, published, first, metadata), f"Particle types have the ids of the {family} family."),
            counts={split: len(paths) for split, paths in files.items()},
        )


def _files(path: Path) -> dict[str, tuple[Path, ...]]:
    """The files of each split, ordered by the numbers in their names."""
    folders = {split: path / split for split in SPLITS}
    if path.is_dir() and path.name in SPLITS and any(path.glob("sim_*.h5")):
        folders = {path.name: path}
    paths = {split: sorted(folder.glob("sim_*.h5"), key=_number) for split, folder in folders.items()}
    return {split: tuple(files) for split, files in paths.items() if files}


def _number(path: Path) -> tuple[int, str]:
    digits = re.findall(r"\d+", path.stem)
    return (int(digits[-1]) if digits else -1, path.name)


def _metadata(path: Path, published: _Published | None, first: Trajectory, options: Options) -> Metadata:
    family = find_family(options.family or "deepmind")
    dim = first.position.shape[2]
    if published is None and options.dt is None:
        raise DataError(
            f"{path}: the files do not state the time between frames, and no published dataset is called"
            f" {path.resolve().name!r} ({', '.join(_PUBLISHED)}). Give --dt, and --gravity and --bounds if"
            " you know them."
        )
    low, high = first.position.min(axis=(0, 1)), first.position.max(axis=(0, 1))
    observed = tuple((float(a), float(b)) for a, b in zip(low, high, strict=True))
    return Metadata(
        bounds=published.domain if published and len(published.domain) == dim else observed,
        dt=published.dt if published else options.dt or 1.0,
        dim=dim,
        sequence_length=UNKNOWN_LENGTH,
        particle_types=dict(family.types),
        static_types=frozenset({_BOUNDARY}),
        gravity=published.gravity if published and published.gravity and len(published.gravity) == dim else None,
    )


def _notes(path: Path, published: _Published | None, first: Trajectory, metadata: Metadata) -> list[str]:
    notes = []
    if published is not None:
        notes.append(
            f"Recognised as the published {path.resolve().name}: dt {metadata.dt:g}, bounds {metadata.bounds}, gravity"
            f" {metadata.gravity or 'as stated in each file'}."
        )
    else:
        notes.append("Bounds are the extent of the first trajectory; give --bounds if you know them.")
    wall = first.particle_type == _BOUNDARY
    if first_moving_particle(first.position, wall, metadata.bounds) is not None:
        notes.append("The boundary moves in the first trajectory.")
    if _GRAVITY in first.fields:
        notes.append("`grav` is kept as a field, and used as gravity in length/s² where it has D numbers.")
    return notes


def _only_material(options: Options, path: Path, files: dict[str, tuple[Path, ...]]) -> int | None:
    """The type of all particles where the files have no types: the only one that the user names."""
    with open_hdf5(next(iter(files.values()))[0]) as file:
        if "types" in file:
            return None
    stated = [i for i in options.types or {} if i != _BOUNDARY]
    if len(stated) != 1:
        raise DataError(f"{path}: the files do not state the particles' material. State it: --types 5=water.")
    return stated[0]


def _trajectories(files: tuple[Path, ...], material: int | None) -> Iterator[Trajectory]:
    for path in files:
        with open_hdf5(path) as file:
            check_self_contained(file, path)
            content = {name: _values(file, name, path) for name in file}
        yield _trajectory(content, material, path)


def _values(file: Any, name: str, path: Path) -> np.ndarray:
    if not isinstance(file[name], h5py.Dataset) or file[name].dtype.kind not in "biuf":
        raise DataError(f"{path}: {name} must be an array of numbers.")
    check_stored_size(file[name], f"{path}: {name}")
    return np.asarray(file[name][()])


def _trajectory(content: dict[str, np.ndarray], material: int | None, path: Path) -> Trajectory:
    moving, wall = _positions(content, "particles", path), _positions(content, "boundary", path)
    frames, particles, dim = moving.shape
    if wall.ndim == 2:
        wall = np.broadcast_to(wall, (frames, *wall.shape))
    if wall.shape[0] != frames or wall.shape[2] != dim:
        raise DataError(f"{path}: particles {moving.shape} and boundary {wall.shape} do not match.")
    types = content.pop("types", np.full(particles, -1 if material is None else material))
    if types.ndim != 1 or len(types) not in (particles, particles + wall.shape[1]):
        raise DataError(
            f"{path}: types {types.shape} match neither {particles} particles nor particles and boundary together."
        )
    kinds = np.concatenate([types[-particles:], np.full(wall.shape[1], _BOUNDARY)]).astype(np.int64)
    gravity = content[_GRAVITY].astype(np.float64) if _GRAVITY in content else np.empty(0)
    attributes = {"gravity": gravity.reshape(dim)} if gravity.size == dim else {}
    try:
        return Trajectory(np.concatenate([moving, wall], axis=1).astype(np.float32), kinds, attributes, content)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _positions(content: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    """Removes an array of positions from a file's content and validates it."""
    array = content.pop(name, None)
    if array is None or array.dtype.kind != "f" or array.ndim not in ((3,) if name == "particles" else (2, 3)):
        problem = "is missing" if array is None else f"is {array.dtype} of shape {array.shape}"
        raise DataError(f"{path}: {name!r} {problem}; expected floats of shape (T, N, D).")
    return array
