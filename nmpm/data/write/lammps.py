"""LAMMPS' text dumps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from nmpm._support.atomic import atomic_write
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter, no_step
from nmpm.data.write.frames import frames
from nmpm.data.write.text import columns, rows


class LammpsDump(TrajectoryWriter):
    """One file of all frames, `id type x y z vx vy vz` and a column for each field; ids the data's, or from 1 on."""

    readers: ClassVar[str] = "OVITO, VMD"

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        box, ids = _box(metadata), trajectory.ids(first=1)
        with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
            for number, frame in enumerate(frames(trajectory, metadata)):
                named = columns(frame)
                file.write(
                    f"ITEM: TIME\n{frame.time!r}\nITEM: TIMESTEP\n{number}\n"
                    f"ITEM: NUMBER OF ATOMS\n{len(frame.index)}\n{box}ITEM: ATOMS id type {' '.join(named)}\n"
                )
                file.write(rows([ids[number, frame.index], frame.particle_type, *named.values()], " "))
                step()
        return path


def _box(metadata: Metadata) -> str:
    """The box; a plane is one unit thick, so that it has a volume."""
    thick = [(-0.5, 0.5)] * (3 - metadata.dim)
    kinds = ["pp" if periodic else "ff" for periodic in metadata.periodic] + ["pp"] * len(thick)
    lines = "".join(f"{low!r} {high!r}\n" for low, high in [*metadata.bounds, *thick])
    return f"ITEM: BOX BOUNDS {' '.join(kinds)}\n{lines}"
