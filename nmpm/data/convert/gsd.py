"""GSD, HOOMD-blue's trajectories; read by gsd. The box is about the origin and periodic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import check_regular
from nmpm._support.messages import install
from nmpm.data.convert.base import readable
from nmpm.data.convert.frame import Frame, wrap
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Boundary, Interval

_ARRAYS = (
    "particletype",
    "velocity",
    "diameter",
    "mass",
    "charge",
    "body",
    "orientation",
    "angmom",
    "density",
    "pressure",
)
_PERIODIC: tuple[Boundary, ...] = ("periodic",) * 3


class Gsd(FrameFormat):
    """Files of many frames; what a frame lacks is that of the first."""

    name: ClassVar[str] = "gsd"
    summary: ClassVar[str] = f"GSD of HOOMD-blue (.gsd; needs: {install('gsd')})"
    patterns: tuple[str, ...] = ("*.gsd",)

    def frames(self, file: Path) -> Iterator[Frame]:
        with _open(file) as content:
            for index in range(content.nframes):
                with readable(file, "GSD", RuntimeError, LookupError, TypeError):
                    frame = _frame(content, index, f"{file}, frame {index}")
                yield frame

    def count(self, file: Path) -> int:
        with _open(file) as content:
            return int(content.nframes)


@contextmanager
def _open(file: Path) -> Iterator[Any]:
    check_regular(file)
    try:
        import gsd.fl
    except ImportError as error:
        raise ConfigError(f"{file}: reading GSD needs gsd: {install('gsd')}.") from error
    with readable(file, "GSD", RuntimeError, LookupError, TypeError):
        content = gsd.fl.open(str(file), "r", schema="hoomd")
    with content:
        yield content


def _frame(content: Any, index: int, where: str) -> Frame:
    def read(name: str) -> np.ndarray | None:
        frame = next((frame for frame in (index, 0) if content.chunk_exists(frame=frame, name=name)), None)
        return None if frame is None else np.asarray(content.read_chunk(frame=frame, name=name))

    position = read("particles/position")
    if position is None or position.ndim != 2:
        raise DataError(f"{where}: it has no particles/position.")
    count = read("particles/N")
    if count is not None and int(count[0]) != len(position):
        raise DataError(f"{where}: it declares {int(count[0])} particles and has positions of {len(position)}.")
    values = {name: read(f"particles/{'typeid' if name == 'particletype' else name}") for name in _ARRAYS}
    arrays = {name: array for name, array in values.items() if array is not None and len(array) == len(position)}
    names = read("particles/types")
    if names is not None and "particletype" in arrays:
        texts = [bytes(row.astype(np.uint8)).split(b"\0")[0].decode("utf-8", "replace") for row in names]
        arrays["type"] = np.array(texts)[arrays["particletype"]]
    own_step = content.chunk_exists(frame=index, name="configuration/step")
    step = int(content.read_chunk(frame=index, name="configuration/step")[0]) if own_step else None
    frame = Frame(position.astype(np.float64), arrays, None, 0 if index == 0 and step is None else step)
    box = _box(read("configuration/box"), where)
    return (
        frame
        if box is None
        else replace(frame, position=wrap(frame.position, box, _PERIODIC), box=box, boundary=_PERIODIC)
    )


def _box(values: np.ndarray | None, where: str) -> tuple[Interval, ...] | None:
    if values is None:
        return None
    lengths, tilts = values[:3], values[3:]
    if tilts.any():
        raise DataError(
            f"{where}: its box is triclinic (tilt {tilts[tilts != 0][0]:g}), only rectangular boxes can be read."
        )
    return tuple((-length / 2, length / 2) for length in lengths.astype(np.float64).tolist())
