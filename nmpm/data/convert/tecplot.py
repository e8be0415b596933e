"""Tecplot's text files, as DaVis exports tracks of Shake-the-Box: a zone per frame, or a file per frame.

`VARIABLES` names the columns, `ZONE` begins a frame, whose `SOLUTIONTIME` is its time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from nmpm._support.bounded_files import starts_with
from nmpm.data.convert.frames import Frame
from nmpm.data.convert.tables import table_frame
from nmpm.data.convert.text_frames import Lines, TextFrames, is_number, parse_columns

_STARTS = (b"TITLE", b"VARIABLES", b"ZONE", b"title", b"variables", b"#!TDV")


class Tecplot(TextFrames):
    """Text files of points; binary ones are refused."""

    summary: ClassVar[str] = "Tecplot's text files of points (.dat, .tec), a zone or a file per frame"
    patterns: tuple[str, ...] = ("*.dat", "*.tec", "*.dat.gz")
    kind: ClassVar[str] = "Tecplot's text"

    def recognises(self, path: Path) -> bool:
        return any(starts_with(file, start) for file in self.first_files(path)[:1] for start in _STARTS)

    def blocks(self, lines: Lines) -> Iterator[tuple[str, tuple[list[str], str], bytes]]:
        number, names, header, rows = 0, list[str](), "", list[bytes]()
        while line := lines.next():
            if is_number(next(iter(line.split()), "")):
                rows.append(line.encode() + b"\n")
                continue
            if rows:
                names = _variables(header) or names
                yield f"zone {number}", (names, header), b"".join(rows)
                number, header, rows = number + 1, "", []
            header += f" {line}"
        if rows:
            yield f"zone {number}", (_variables(header) or names, header), b"".join(rows)

    def frame(self, header: tuple[list[str], str], block: bytes) -> Frame:
        names, text = header
        match = re.search(r"SOLUTIONTIME\s*=\s*([-+.\deE]+)", text, re.IGNORECASE)
        time = float(match[1]) if match and is_number(match[1]) else None
        return replace(table_frame(parse_columns(block, names)), time=time)


def _variables(header: str) -> list[str]:
    """The names after VARIABLES, quoted or not; none where they are as before."""
    if re.search(r"(DATAPACKING|F)\s*=\s*BLOCK", header, re.IGNORECASE):
        raise ValueError("its values are in blocks; write them with DATAPACKING=POINT")
    match = re.search(r"VARIABLES\s*=(.*?)(?=\b(?:ZONE|DATASETAUXDATA)\b|$)", header, re.IGNORECASE | re.DOTALL)
    quoted = re.findall(r'"([^"]*)"', match[1]) if match else []
    return quoted or (re.split(r"[\s,]+", match[1].strip()) if match else [])
