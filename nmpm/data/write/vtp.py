"""VTK's XML poly data: a file per frame, and one that lists them with their times."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.atomic import atomic_folder, atomic_write, file_obstacle
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.write.base import TrajectoryWriter, no_step
from nmpm.data.write.frames import Frame, frames

_HEAD = '<VTKFile type="{}" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
_VTK_TYPES = {"f4": "Float32", "f8": "Float64", "i8": "Int64"}


class VtpSeries(TrajectoryWriter):
    """`out.pvd` and beside it the folder `out` of a .vtp per frame."""

    readers: ClassVar[str] = "ParaView, VisIt, PyVista"

    def write(
        self, path: Path, trajectory: Trajectory, metadata: Metadata, step: Callable[[], object] = no_step
    ) -> Path:
        folder, collection, lines = path.with_suffix(""), path.with_suffix(".pvd"), list[str]()
        with atomic_folder(folder) as new:
            for number, frame in enumerate(frames(trajectory, metadata)):
                (new / f"{number:06d}.vtp").write_bytes(vtp(frame))
                lines.append(f'<DataSet timestep="{frame.time!r}" file="{escape(folder.name)}/{number:06d}.vtp"/>\n')
                step()
        with atomic_write(collection) as part:
            text = f"{_HEAD.format('Collection')}<Collection>\n{''.join(lines)}</Collection>\n</VTKFile>\n"
            part.write_text(text, encoding="utf-8")
        return collection

    def obstacle(self, path: Path) -> str:
        folder, collection = path.with_suffix(""), path.with_suffix(".pvd")
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
        is_series = collection.is_file() and all(re.fullmatch(r"\d{6,}\.vtp", name) for name in names)
        if folder.is_file() or (names and not is_series):
            return f"its frames would replace {folder}, which is not such a series; choose another name."
        return file_obstacle(collection)


def vtp(frame: Frame) -> bytes:
    """A frame as VTK's XML, with the numbers behind it as they are."""
    count, blocks = len(frame.index), list[bytes]()

    def array(name: str, values: np.ndarray) -> str:
        kind = "f8" if values.dtype == np.float64 else "f4" if values.dtype.kind == "f" else "i8"
        content = values.astype(f"<{kind}").tobytes()
        offset = sum(map(len, blocks))
        blocks.append(len(content).to_bytes(8, "little") + content)
        parts = "" if values.ndim == 1 else f' NumberOfComponents="{values.shape[1]}"'
        return (
            f'<DataArray type="{_VTK_TYPES[kind]}" Name="{escape(name)}"{parts} format="appended" offset="{offset}"/>\n'
        )

    data = {"id": frame.id, "particle_type": frame.particle_type, **frame.fields}
    text = (
        f'{_HEAD.format("PolyData")}<PolyData>\n<Piece NumberOfPoints="{count}" NumberOfVerts="{count}">\n'
        f"<Points>\n{array('Points', frame.position)}</Points>\n"
        f"<Verts>\n{array('connectivity', np.arange(count))}{array('offsets', np.arange(1, count + 1))}</Verts>\n"
        f"<PointData>\n{''.join(array(name, values) for name, values in data.items())}</PointData>\n"
        '</Piece>\n</PolyData>\n<AppendedData encoding="raw">\n_'
    )
    return text.encode() + b"".join(blocks) + b"\n</AppendedData>\n</VTKFile>\n"
