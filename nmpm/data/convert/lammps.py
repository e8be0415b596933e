"""LAMMPS's text dumps, plain or gzipped; many frames in a file or a file per frame.

A frame is `ITEM: TIMESTEP`, `ITEM: NUMBER OF ATOMS`, `ITEM: BOX BOUNDS`, and `ITEM: ATOMS` with names of columns.
`ITEM: UNITS` and `ITEM: TIME` may stand before it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.messages import counted, one_line
from nmpm.data.convert.base import Options
from nmpm.data.convert.frames import Frame, wrap
from nmpm.data.convert.named_arrays import AXES
from nmpm.data.convert.tables import number_columns
from nmpm.data.convert.text_frames import Lines, TextFrames, complete_frames, parse_columns
from nmpm.scene import Boundary, Interval

_log = logging.getLogger(__name__)

_ENDS = ("", "s", "u", "su")  # of the coordinates' names: plain, scaled by the box, unwrapped, both
_IMAGES = ("ix", "iy", "iz")


@dataclass(frozen=True)
class _Header:
    """What stands before the particles of a frame."""

    start: int  # lines before it
    step: int
    time: float | None
    count: int
    box: tuple[Interval, ...]
    flags: tuple[str, ...]  # per axis, such as "pp"; empty in old files
    columns: tuple[str, ...]


class Lammps(TextFrames):
    """LAMMPS text dumps; particles are sorted by id."""

    summary: ClassVar[str] = "text dumps of LAMMPS and LIGGGHTS, by their content; also gzipped"
    patterns: tuple[str, ...] = ("*.lammpstrj", "*.lammpstrj.gz", "*.dump", "*.dump.gz", "dump.*")
    signature: ClassVar[bytes] = b"ITEM: "
    kind: ClassVar[str] = "a LAMMPS dump"

    def frames(self, file: Path) -> Iterator[Frame]:
        before, repeated = None, 0
        for frame in super().frames(file):
            # A simulation that goes on writes the last frame of the one before again.
            if frame.step == before:
                repeated += 1
            else:
                yield frame
            before = frame.step
        if repeated:
            _log.warning("%s: %s repeated the timestep before and left out.", file, counted(repeated, "frame"))

    def blocks(self, lines: Lines) -> Iterator[tuple[str, _Header, bytes]]:
        while (header := _header(lines)) is not None:
            yield f"timestep {header.step}", header, lines.block(header.count, header.start)

    def frame(self, header: _Header, block: bytes) -> Frame:
        columns = parse_columns(block, header.columns)
        end = next((end for end in _ENDS if "x" + end in columns and "y" + end in columns), None)
        if end is None:
            found = " ".join(header.columns)
            raise ValueError(f"no columns x y, xs ys, xu yu or xsu ysu of coordinates (found: {found})")
        position = number_columns(columns, [axis + end for axis in AXES if axis + end in columns])
        box = header.box[: position.shape[1]]
        if end.startswith("s"):
            low, high = np.array(box).T
            position = low + position * (high - low)
        boundary: tuple[Boundary, ...] = tuple("periodic" if flag == "pp" else "wall" for flag in header.flags)
        position = wrap(position, header.box, boundary)
        others = {axis + end for axis in AXES for end in _ENDS}.union(_IMAGES)
        arrays = {name: values for name, values in columns.items() if name not in others}
        # Shrink-wrapped boxes (s, m) follow the particles: they state no bounds.
        fixed = bool(header.flags) and not any(set(flag) & set("sm") for flag in header.flags[: len(box)])
        return Frame(position, arrays, header.time, header.step, header.box if fixed else None, boundary or None)

    def notes(self, frames: Sequence[Frame], options: Options) -> tuple[str, ...]:
        steps = [frame.step for frame in frames if frame.step is not None]
        if len(steps) < 2 or options.dt is not None or frames[0].time is not None:
            return ()
        apart = steps[1] - steps[0]
        return (f"Frames are {apart} steps of LAMMPS apart; if dt is not the time between them, state it: --dt.",)


def _header(lines: Lines) -> _Header | None:
    """The lines of a frame before its particles; None at the end of the file."""
    start, step = lines.number, None
    time: float | None = None
    count, box, flags = -1, list[Interval](), tuple[str, ...]()
    while line := lines.next():
        if line.startswith("ITEM: ATOMS") and step is not None and count >= 0 and box:
            return _Header(start, step, time, count, tuple(box), flags, tuple(line.split()[2:]))
        if line.startswith("ITEM: TIMESTEP"):
            step = int(lines.next())
        elif line.startswith("ITEM: TIME"):
            time = float(lines.next())
        elif line.startswith("ITEM: NUMBER OF ATOMS"):
            count = int(lines.next())
        elif line.startswith("ITEM: BOX BOUNDS"):
            flags = tuple(word for word in line.split()[3:] if len(word) == 2 and set(word) <= set("pfsm"))
            if len(flags) not in (0, len(AXES)):
                raise ValueError(f"line {lines.number} has {len(flags)} boundaries, not one for each of three axes")
            box = []
            for _ in AXES:
                text = lines.next()
                low, high, *tilt = map(float, text.split())
                if any(tilt):
                    raise ValueError(f"its box is triclinic (tilt {tilt[0]:g}), only rectangular boxes can be read")
                if not np.isfinite([low, high]).all() or low > high:
                    raise ValueError(f"the bounds {text} of its box are not ascending")
                box.append((low, high))
        elif line.startswith("ITEM: UNITS"):
            lines.next()
        else:
            names = "TIMESTEP, NUMBER OF ATOMS, BOX BOUNDS and then ATOMS"
            raise ValueError(f"line {lines.number} is {one_line(line, 60)!r}; expected ITEM: {names}")
    if step is not None:
        raise ValueError(f"it ends at line {lines.number}, within a frame{complete_frames(start)}")
    return None
