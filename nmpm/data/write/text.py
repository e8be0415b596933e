"""Text with a row for each particle in each frame, as CSV and LAMMPS' dumps; and NumPy's archives."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.atomic import atomic_write
from nmpm.data.format import ID, Trajectory
from nmpm.data.write.base import Clip, ClipFrame, TextWriter, TrajectoryWriter

_AXES = "xyz"
_PATTERNS = {"f": "%.9g", "U": "%s"}


def columns(frame: ClipFrame, dim: int = 3) -> dict[str, np.ndarray]:
    """(n,) numbers by name: `x, y, z` of positions, `vx, vy, vz` of velocities, `name_x, …` of other vectors."""
    arrays = {"": frame.position, **frame.fields}
    named: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if values.ndim == 1:
            named[re.sub(r"\W", "_", name)] = values
            continue
        prefix = {"": "", "velocity": "v"}.get(name, re.sub(r"\W", "_", name) + "_")
        named |= {prefix + axis: values[:, number] for number, axis in enumerate(_AXES[:dim])}
    return named


def rows(numbers: list[np.ndarray], separator: str) -> str:
    """A line for each of n particles, of (n,) arrays of numbers or texts; float32 are read back exactly."""
    pattern = separator.join(_PATTERNS.get(array.dtype.kind, "%d") for array in numbers) + "\n"
    return "".join(map(pattern.__mod__, zip(*(array.tolist() for array in numbers), strict=True)))


class Csv(TextWriter):
    """Columns `frame, time, id, type, x, y[, z], vx, …`, one for each field, and the type's name as `material`."""

    readers: ClassVar[str] = "spreadsheets, pandas, R"

    def text(self, clip: Clip) -> Iterator[str]:
        names = clip.metadata.particle_types
        for frame in clip.frames():
            count, named = len(frame.index), columns(frame, clip.metadata.dim)
            if frame.number == 0:
                yield ",".join(("frame", "time", "id", "type", *named, "material")) + "\n"
            numbers, times = np.full(count, frame.number), np.full(count, frame.time)
            material = _quoted(np.array([names.get(i, "") for i in frame.particle_type.tolist()]))
            yield rows([numbers, times, _quoted(frame.label), frame.particle_type, *named.values(), material], ",")

    def left_out(self, trajectory: Trajectory) -> set[str]:
        return super().left_out(trajectory) - {ID}


def _quoted(cells: np.ndarray) -> np.ndarray:
    """Cells, texts with a comma or quotation mark in quotation marks."""
    if cells.dtype.kind != "U":
        return cells
    special = np.array([re.search('[,"\\n]', text) is not None for text in cells.tolist()], bool)
    return np.where(special, np.char.add(np.char.add('"', np.char.replace(cells, '"', '""')), '"'), cells)


class LammpsDump(TextWriter):
    """One file of all frames, `id type x y z vx vy vz` and a column for each field; ids the data's, or from 1 on."""

    readers: ClassVar[str] = "OVITO, VMD"

    def text(self, clip: Clip) -> Iterator[str]:
        thick = [(-0.5, 0.5)] * (3 - clip.metadata.dim)  # a plane is one unit thick, so that it has a volume
        kinds = ["pp" if periodic else "ff" for periodic in clip.metadata.periodic] + ["pp"] * len(thick)
        bounds = "".join(f"{low!r} {high!r}\n" for low, high in [*clip.metadata.bounds, *thick])
        box, ids = f"ITEM: BOX BOUNDS {' '.join(kinds)}\n{bounds}", clip.trajectory.ids(first=1)
        for frame in clip.frames():
            named = columns(frame)
            yield (
                f"ITEM: TIME\n{frame.time!r}\nITEM: TIMESTEP\n{frame.number}\n"
                f"ITEM: NUMBER OF ATOMS\n{len(frame.index)}\n{box}ITEM: ATOMS id type {' '.join(named)}\n"
            )
            yield rows([ids[frame.number, frame.index], frame.particle_type, *named.values()], " ")


class Npz(TrajectoryWriter):
    """`position` (T, N, D), `particle_type` (N,), `time` (T,), fields, and facts of the scene; `type_names` by id."""

    readers: ClassVar[str] = "NumPy"

    def write(self, path: Path, clip: Clip) -> Path:
        trajectory, metadata = clip.trajectory, clip.metadata
        facts: dict[str, Any] = {
            "dt": metadata.dt,
            "bounds": metadata.bounds,
            "boundary": metadata.boundary,
            "gravity": trajectory.attributes.get("gravity", metadata.gravity),
            "particle_volume": metadata.particle_volume,
            "static_types": sorted(metadata.static_types),
            "type_names": [metadata.particle_types.get(i, "") for i in range(1 + max(metadata.particle_types))],
        }
        arrays = {
            **{name: np.array(value) for name, value in facts.items() if value is not None},
            **trajectory.fields,
            "time": clip.times,
            "position": trajectory.position,
            "particle_type": trajectory.particle_type,
        }
        with atomic_write(path) as part, part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        clip.step_all()
        return path

    def left_out(self, trajectory: Trajectory) -> set[str]:  # noqa: ARG002
        return set()
