"""PLY files of points, a file per frame; read by plyfile."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm.data.convert.base import needs, readable
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame
from nmpm.data.convert.named_arrays import AXES
from nmpm.data.convert.text_frames import is_number
from nmpm.errors import DataError

_TIME = re.compile(r"time\W+([-+.\deE]+)\s*$", re.IGNORECASE)


class Ply(FrameFormat):
    """The element `vertex` of PLY files; a comment such as `time 0.5` states the time."""

    summary: ClassVar[str] = "PLY files of points, a file per frame (extra vtk)"
    patterns: tuple[str, ...] = ("*.ply",)
    signature: ClassVar[bytes] = b"ply"

    def frames(self, file: Path) -> Iterator[Frame]:
        needs(file, "PLY", "plyfile", "vtk")
        import plyfile

        with readable(file, "PLY", plyfile.PlyParseError, LookupError, TypeError):
            size = file.stat().st_size
            with file.open("rb") as stream:
                header = plyfile.PlyData._parse_header(stream)
            for element in header.elements:
                row = 2 * len(element.properties) if header.text else element.dtype().itemsize  # (lists are pointers)
                has_lists = any(hasattr(each, "len_dtype") for each in element.properties)
                if element.count * (1 if has_lists and not header.text else row) > size + 1:
                    raise ValueError(f"it declares {element.count:,} rows of {element.name} but has {size:,} bytes")
            content: Any = plyfile.PlyData.read(str(file))
        elements = {element.name: element for element in content.elements}
        vertices: Any = elements["vertex"].data if "vertex" in elements else np.zeros(0)
        names = vertices.dtype.names or ()
        axes = [axis for axis in AXES if axis in names]
        if len(axes) < 2:
            found = ", ".join([*elements, *names])
            raise DataError(f"{file}: it has no element vertex with x, y (found: {found}).")
        position = np.stack([vertices[axis].astype(np.float64) for axis in axes], axis=1)
        lists = [name for name in names if vertices[name].dtype == object]
        arrays = {name: np.array(vertices[name]) for name in names if name not in {*axes, *lists}}
        times = (_TIME.search(comment) for comment in (*content.comments, *content.obj_info))
        stated = next((match[1] for match in times if match), "")
        left_out = (*(name for name in elements if name != "vertex"), *lists)
        yield Frame(position, arrays, float(stated) if is_number(stated) else None, left_out=left_out)
