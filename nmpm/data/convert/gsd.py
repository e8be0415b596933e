"""GSD, HOOMD-blue's trajectories. The box is about the origin and periodic.

They are read by gsd, which crashes on damaged files: in child processes (`nmpm._support.isolated`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm.data.convert.base import located, needs, readable
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import Frame, wrap
from nmpm.errors import DataError
from nmpm.scene import Boundary

_STEP = "configuration/step"
_LASTING = (
    "configuration/box",
    *(
        f"particles/{name}"
        for name in (
            "N", "position", "typeid", "types", "velocity", "diameter", "mass", "charge", "body", "orientation",
            "angmom", "density", "pressure",
        )
    ),
)  # fmt: skip
"""Chunks that are those of the first frame where a frame lacks them."""
_FACTS = ("N", "position", "typeid", "types")
_PERIODIC: tuple[Boundary, ...] = ("periodic",) * 3


class Gsd(FrameFormat):
    """Files of many frames; what a frame lacks is that of the first."""

    summary: ClassVar[str] = "GSD of HOOMD-blue (.gsd; extra gsd)"
    patterns: tuple[str, ...] = ("*.gsd",)

    def frames(self, file: Path) -> Iterator[Frame]:
        needs(file, "GSD", "gsd", "gsd")
        for index, chunks in enumerate(iterate_isolated(read_chunks, file)):
            with readable(file, "GSD", LookupError, TypeError), located(f"{file}, frame {index}"):
                frame = _frame(chunks, index)
            yield frame

    def count(self, file: Path) -> int:
        needs(file, "GSD", "gsd", "gsd")
        return int(call_isolated(count_frames, file))


def read_chunks(path: Path) -> Iterator[dict[str, Any]]:
    """Yields the arrays of each frame, by the names of their chunks."""
    import gsd.fl

    with gsd.fl.open(str(path), "r", schema="hoomd") as content:
        for index in range(content.nframes):
            frames = {
                name: next((frame for frame in (index, 0) if content.chunk_exists(frame=frame, name=name)), None)
                for name in _LASTING
            }
            frames[_STEP] = index if content.chunk_exists(frame=index, name=_STEP) else None
            yield {
                name: content.read_chunk(frame=frame, name=name) for name, frame in frames.items() if frame is not None
            }


def count_frames(path: Path) -> int:
    """Number of frames."""
    import gsd.fl

    with gsd.fl.open(str(path), "r", schema="hoomd") as content:
        return int(content.nframes)


def _frame(chunks: Mapping[str, np.ndarray], index: int) -> Frame:
    inside = {name.removeprefix("particles/"): each for name, each in chunks.items() if name.startswith("particles/")}
    position, count, types, names = (inside.get(name) for name in ("position", "N", "typeid", "types"))
    if position is None or position.ndim != 2:
        raise DataError("it has no particles/position.")
    if count is not None and int(count[0]) != len(position):
        raise DataError(f"it declares {int(count[0])} particles and has positions of {len(position)}.")
    arrays = {name: each for name, each in inside.items() if name not in _FACTS and len(each) == len(position)}
    if types is not None and len(types) == len(position):
        arrays["particletype"] = types
        if names is not None:
            texts = [bytes(row.astype(np.uint8)).split(b"\0")[0].decode("utf-8", "replace") for row in names]
            arrays["type"] = np.array(texts)[types]
    step = chunks.get(_STEP)
    number = (0 if index == 0 else None) if step is None else int(step[0])
    position = position.astype(np.float64)
    if (values := chunks.get("configuration/box")) is None:
        return Frame(position, arrays, None, number)
    lengths, tilts = values[:3].astype(np.float64).tolist(), values[3:]
    if tilts.any():
        raise DataError(f"its box is triclinic (tilt {tilts[tilts != 0][0]:g}), only rectangular boxes can be read.")
    box = tuple((-length / 2, length / 2) for length in lengths)
    return Frame(wrap(position, box, _PERIODIC), arrays, None, number, box, _PERIODIC)
