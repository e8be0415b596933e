"""Frames of a GSD file, read by gsd, which crashes on damaged files: for child processes (`nmpm._support.isolated`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

_NAMES = (
    "configuration/box",
    "particles/N",
    "particles/position",
    "particles/typeid",
    "particles/types",
    *(
        f"particles/{name}"
        for name in ("velocity", "diameter", "mass", "charge", "body", "orientation", "angmom", "density", "pressure")
    ),
)
"""Chunks that are those of the first frame where a frame lacks them."""
STEP = "configuration/step"


def read_chunks(path: Path) -> Iterator[dict[str, Any]]:
    """Yields the arrays of each frame, by the names of their chunks."""
    import gsd.fl

    with gsd.fl.open(str(path), "r", schema="hoomd") as content:
        for index in range(content.nframes):
            places = {
                name: next((frame for frame in (index, 0) if content.chunk_exists(frame=frame, name=name)), None)
                for name in _NAMES
            }
            places[STEP] = index if content.chunk_exists(frame=index, name=STEP) else None
            yield {
                name: content.read_chunk(frame=frame, name=name) for name, frame in places.items() if frame is not None
            }


def count_frames(path: Path) -> int:
    """Number of frames."""
    import gsd.fl

    with gsd.fl.open(str(path), "r", schema="hoomd") as content:
        return int(content.nframes)
