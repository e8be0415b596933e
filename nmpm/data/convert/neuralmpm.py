"""NeuralMPM's datasets: a folder per split, a file `sim_*.h5` per trajectory.

Each file holds `particles` (T, N, D), `boundary` (T, M, D) and, where there are several materials, `types` (N,) or
(M + N,), the boundary's first; anything else, such as `grav`, is per trajectory. The files state neither
the time between frames nor the walls: for the published datasets (Rochman-Sharabi, Lewin, Louppe, 2025) a table does.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np

from nmpm._support.machine import check_fits
from nmpm.data.convert.base import UNKNOWN_LENGTH, Facts, ForeignDataset, Options, RunFiles, located
from nmpm.data.families import find_family
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.hdf5 import check_self_contained, check_stored_size, open_hdf5
from nmpm.data.statistics import extent_of, first_moving_particle
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


class NeuralMpm(RunFiles):
    """A folder with folders train, valid and test of `sim_*.h5` files, or one of these.

    Attributes:
        material: Type id that the user states for the particles of files without types.
    """

    summary: ClassVar[str] = "NeuralMPM's folders of sim_*.h5 files, also from the hub's iSach/NeuralMPM"
    patterns: tuple[str, ...] = ("sim_*.h5",)
    fixed_names: ClassVar[bool] = True
    family: ClassVar[str] = "deepmind"
    material: int | None = None

    def recognises(self, path: Path) -> bool:
        files = self.files(path)
        try:
            with open_hdf5(next(iter(files.values()))[0]) if files else nullcontext(()) as content:
                return not {"particles", "boundary"}.isdisjoint(content)
        except DataError:
            return True  # damaged

    def open(self, path: Path, options: Options) -> ForeignDataset:
        reader, materials = copy.copy(self), [i for i in options.types or {} if i != _BOUNDARY]
        reader.material = materials[0] if len(materials) == 1 else None
        return super(NeuralMpm, reader).open(path, options)

    def facts(self, file: Path, options: Options) -> Facts:
        folder = file.resolve().parent.parent
        published = _PUBLISHED.get(folder.name.lower())
        first = _trajectory(_content(file), published.material if published else None, file)
        if published is None and options.dt is None:
            raise DataError(
                f"{folder}: the files do not state the time between frames, and no published dataset is called"
                f" {folder.name!r} ({', '.join(_PUBLISHED)}). Give --dt, and --gravity and --bounds if you know them."
            )
        dim = first.position.shape[2]
        fits = published is not None and len(published.domain) == dim
        metadata = Metadata(
            bounds=published.domain if published and fits else extent_of(first.position).intervals,
            dt=published.dt if published else options.dt or 1.0,
            dim=dim,
            sequence_length=UNKNOWN_LENGTH,
            particle_types=dict(find_family(options.family or self.family).types),
            static_types=frozenset({_BOUNDARY}),
            gravity=published.gravity if published and fits else None,
        )
        stated = options.apply_to(metadata)
        notes = [
            f"Recognised as the published {folder.name}: dt {stated.dt:g}, bounds {stated.bounds}, gravity"
            f" {stated.gravity or 'as stated in each file'}."
            if published
            else "Bounds are the extent of the first trajectory; give --bounds if you know them."
        ]
        if first_moving_particle(first.position, first.particle_type == _BOUNDARY, stated.bounds) is not None:
            notes.append("The boundary moves in the first trajectory.")
        if _GRAVITY in first.fields:
            notes.append("`grav` is kept as a field, and used as gravity in length/s² where it has D numbers.")
        return Facts(metadata, notes=tuple(notes))

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        published, content = _PUBLISHED.get(file.resolve().parent.parent.name.lower()), _content(file)
        material = published.material if published else self.material
        if published is None and "types" not in content and material is None:
            raise DataError(f"{file}: it does not state the particles' material. State it: --types 5=water.")
        yield _trajectory(content, material, file)


def _content(path: Path) -> dict[str, np.ndarray]:
    content: dict[str, np.ndarray] = {}
    with open_hdf5(path) as file:
        check_self_contained(file, path)
        for name in file:
            if not isinstance(file[name], h5py.Dataset) or file[name].dtype.kind not in "biuf":
                raise DataError(f"{path}: {name} must be an array of numbers.")
            check_stored_size(file[name], f"{path}: {name}")
            content[name] = np.asarray(file[name][()])
    return content


def _trajectory(content: dict[str, np.ndarray], material: int | None, path: Path) -> Trajectory:
    moving, wall = _positions(content, "particles", path), _positions(content, "boundary", path)
    frames, particles, dim = moving.shape
    if wall.ndim == 2:
        check_fits(frames, len(wall), dim, str(path))
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
    with located(path):
        return Trajectory(np.concatenate([moving, wall], axis=1).astype(np.float32), kinds, attributes, content)


def _positions(content: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    """Removes an array of positions from a file's content and validates it."""
    array = content.pop(name, None)
    if array is None or array.dtype.kind != "f" or array.ndim not in ((3,) if name == "particles" else (2, 3)):
        problem = "is missing" if array is None else f"is {array.dtype} of shape {array.shape}"
        raise DataError(f"{path}: {name!r} {problem}; expected floats of shape (T, N, D).")
    return array
