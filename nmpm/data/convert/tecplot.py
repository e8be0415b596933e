"""Tecplot's text files, as DaVis exports tracks of Shake-the-Box: a zone per frame, or a file per frame.

`VARIABLES` names the columns, `ZONE` begins a frame, whose `SOLUTIONTIME` is its time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.convert.frame import ARRAY_NAMES, Frame
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.tables import as_numbers, plain_column
from nmpm.data.convert.text_lines import Lines, is_number, open_lines, parse_columns, starts_with
from nmpm.data.convert.tracks import coordinate_columns
from nmpm.errors import DataError

_STARTS = (b"TITLE", b"VARIABLES", b"ZONE", b"title", b"variables", b"#!TDV")


class Tecplot(FrameFormat):
    """Text files of points; binary ones are refused."""

    name: ClassVar[str] = "tecplot"
    summary: ClassVar[str] = "Tecplot's text files of points (.dat, .tec), a zone or a file per frame"
    patterns: tuple[str, ...] = ("*.dat", "*.tec", "*.dat.gz")

    def recognises(self, path: Path) -> bool:
        _, files = next(self._folders(path), (path, []))
        return any(starts_with(file, start) for file in files[:1] for start in _STARTS)

    def frames(self, file: Path) -> Iterator[Frame]:
        with open_lines(file, "Tecplot's text") as lines:
            for number, (names, time, block) in enumerate(_zones(lines)):
                yield _frame(names, time, block, f"{file}, zone {number}")


def _zones(lines: Lines) -> Iterator[tuple[list[str], float | None, bytes]]:
    """Yields the columns, the time and the rows of each zone."""
    names, header, rows = list[str](), "", list[bytes]()
    while line := lines.next():
        if is_number(next(iter(line.split()), "")):
            rows.append(line.encode() + b"\n")
            continue
        if rows:
            names = _variables(header) or names
            yield names, _time(header), b"".join(rows)
            header, rows = "", []
        header += f" {line}"
    if rows:
        yield _variables(header) or names, _time(header), b"".join(rows)


def _variables(header: str) -> list[str]:
    """The names after VARIABLES, quoted or not; none where they are as before."""
    if re.search(r"(DATAPACKING|F)\s*=\s*BLOCK", header, re.IGNORECASE):
        raise ValueError("its values are in blocks; write them with DATAPACKING=POINT")
    match = re.search(r"VARIABLES\s*=(.*?)(?=\b(?:ZONE|DATASETAUXDATA)\b|$)", header, re.IGNORECASE | re.DOTALL)
    quoted = re.findall(r'"([^"]*)"', match[1]) if match else []
    return quoted or (re.split(r"[\s,]+", match[1].strip()) if match else [])


def _time(header: str) -> float | None:
    match = re.search(r"SOLUTIONTIME\s*=\s*([-+.\deE]+)", header, re.IGNORECASE)
    return float(match[1]) if match and is_number(match[1]) else None


def _frame(names: list[str], time: float | None, rows: bytes, where: str) -> Frame:
    coordinates = coordinate_columns(names)
    if not coordinates:
        raise DataError(f"{where}: no variables x, y of coordinates (found: {', '.join(names[:12]) or 'none'}).")
    try:
        columns = parse_columns(rows, names)
    except ValueError as error:
        raise DataError(f"{where}: {one_line(error)}.") from error
    position = np.stack(
        [as_numbers(columns.pop(name), f"{where}: the variable {name}") for name in coordinates], axis=1
    )
    arrays = {plain_column(n) if plain_column(n) in ARRAY_NAMES else n: values for n, values in columns.items()}
    return Frame(position, arrays, time)
