"""GSD, HOOMD-blue's trajectories; read by gsd. The box is about the origin and periodic."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.bounded_files import check_regular
from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm._support.messages import install
from nmpm.data.convert.base import readable
from nmpm.data.convert.frame import Frame, wrap
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.gsd_chunks import STEP, count_frames, read_chunks
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Boundary, Interval

_FACTS = ("N", "position", "typeid", "types")
_PERIODIC: tuple[Boundary, ...] = ("periodic",) * 3


class Gsd(FrameFormat):
    """Files of many frames; what a frame lacks is that of the first."""

    name: ClassVar[str] = "gsd"
    summary: ClassVar[str] = "GSD of HOOMD-blue (.gsd; extra gsd)"
    patterns: tuple[str, ...] = ("*.gsd",)

    def frames(self, file: Path) -> Iterator[Frame]:
        _check(file)
        for index, chunks in enumerate(iterate_isolated(read_chunks, file)):
            with readable(file, "GSD", LookupError, TypeError):
                frame = _frame(chunks, index, f"{file}, frame {index}")
            yield frame

    def count(self, file: Path) -> int:
        _check(file)
        return int(call_isolated(count_frames, file))


def _check(file: Path) -> None:
    check_regular(file)
    if find_spec("gsd") is None:
        raise ConfigError(f"{file}: reading GSD needs gsd: {install('gsd')}.")


def _frame(chunks: Mapping[str, np.ndarray], index: int, where: str) -> Frame:
    position, count, step = (chunks.get(name) for name in ("particles/position", "particles/N", STEP))
    if position is None or position.ndim != 2:
        raise DataError(f"{where}: it has no particles/position.")
    if count is not None and int(count[0]) != len(position):
        raise DataError(f"{where}: it declares {int(count[0])} particles and has positions of {len(position)}.")
    own = {name.removeprefix("particles/"): values for name, values in chunks.items() if name.startswith("particles/")}
    arrays = {name: values for name, values in own.items() if name not in _FACTS and len(values) == len(position)}
    types, names = own.get("typeid"), own.get("types")
    if types is not None and len(types) == len(position):
        arrays["particletype"] = types
    if names is not None and "particletype" in arrays:
        texts = [bytes(row.astype(np.uint8)).split(b"\0")[0].decode("utf-8", "replace") for row in names]
        arrays["type"] = np.array(texts)[arrays["particletype"]]
    number = (0 if index == 0 else None) if step is None else int(step[0])
    frame = Frame(position.astype(np.float64), arrays, None, number)
    box = _box(chunks.get("configuration/box"), where)
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
