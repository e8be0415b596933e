"""XYZ files, plain, extended or gzipped; many frames in a file or a file per frame.

A frame is a line with the number of particles, a comment, and a line per particle. In extended XYZ, the comment has
keys: `Properties=species:S:1:pos:R:3:vel:R:3` names the columns, `Time`, `Lattice` and `pbc` state time and box. Else
columns are a name or type, x, y, z, and velocities if there are three more.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.convert.frames import Frame, wrap
from nmpm.data.convert.named_arrays import AXES
from nmpm.data.convert.text_frames import Lines, TextFrames, parse_columns
from nmpm.scene import Boundary, Interval

_MOST_COLUMNS = 10_000
_KEY = re.compile(r"(\w+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)'|(\S+))")


class Xyz(TextFrames):
    """XYZ files."""

    summary: ClassVar[str] = "XYZ and extended XYZ (.xyz, .extxyz), also gzipped"
    patterns: tuple[str, ...] = ("*.xyz", "*.extxyz", "*.xyz.gz", "*.extxyz.gz")
    kind: ClassVar[str] = "XYZ"

    def blocks(self, lines: Lines) -> Iterator[tuple[str, str, bytes]]:
        number = 0
        while line := lines.next():
            start, count = lines.number - 1, line.strip()
            if not count:
                continue
            if not count.isdecimal():
                raise ValueError(f"line {lines.number} is {one_line(line, 60)!r}; expected the number of particles")
            yield f"frame {number}", lines.next(), lines.block(int(count), start)
            number += 1

    def frame(self, header: str, block: bytes) -> Frame:
        keys = {match[1].lower(): match[2] or match[3] or match[4] or "" for match in _KEY.finditer(header)}
        width = len(block.partition(b"\n")[0].split())
        if "properties" in keys:
            names = _columns(keys["properties"], width)
        else:
            width = width or 4
            rest = [("velocity", 3)] if width == 7 else [(f"column{index}", 1) for index in range(5, width + 1)]
            names = [("type", 1), ("pos", max(1, min(width - 1, 3))), *rest]
        columns = parse_columns(block, [f"{name}/{part}" for name, width in names for part in range(width)])
        arrays: dict[str, np.ndarray] = {}  # (N,) or (N, k)
        for name, width in names:
            first, *others = (columns[f"{name}/{part}"] for part in range(width))
            digits = first.dtype.kind == "U" and len(first) > 0 and np.char.isdigit(first).all()
            single = first.astype(np.int64) if digits else first
            arrays[name] = np.stack([first, *others], axis=1) if others else single
        position = arrays.pop("pos")
        if position.ndim != 2 or position.shape[1] > len(AXES) or position.dtype.kind != "f":
            raise ValueError("expected two or three columns of coordinates")
        box, boundary = _box(keys)
        time = float(keys["time"]) if "time" in keys else None
        return Frame(wrap(position, box, boundary), arrays, time, None, box, boundary)


def _columns(properties: str, present: int) -> list[tuple[str, int]]:
    """Names and widths of the columns that `Properties` lists; as many as are present, where there are particles."""
    words = properties.split(":")
    if len(words) % 3 or not all(width.isdecimal() for width in words[2::3]) or "pos" not in words[::3]:
        raise ValueError(f"Properties={one_line(properties, 60)} does not list names, kinds and widths, or has no pos")
    widths = [int(width[:10]) for width in words[2::3]]
    if 0 in widths or (sum(widths) != present and present) or sum(widths) > _MOST_COLUMNS:
        raise ValueError(f"Properties={one_line(properties, 60)} lists {sum(widths):,} columns, not {present}")
    return list(zip(words[::3], widths, strict=True))


def _box(keys: dict[str, str]) -> tuple[tuple[Interval, ...] | None, tuple[Boundary, ...] | None]:
    """The box and its boundary, where an axis is periodic; else neither is stated."""
    periodic = [word.lower() in ("t", "true", "1") for word in keys.get("pbc", "").split()]
    if "lattice" not in keys or not any(periodic):
        return None, None
    lattice = np.array(keys["lattice"].split(), float).reshape(3, 3)
    if (lattice != np.diag(np.diag(lattice))).any():
        raise ValueError("its box is not rectangular; only rectangular boxes can be read")
    origin = np.array(keys.get("origin", "0 0 0").split(), float)
    box = tuple(zip(origin.tolist(), (origin + np.diag(lattice)).tolist(), strict=True))
    return box, tuple("periodic" if wraps else "wall" for wraps in periodic)
