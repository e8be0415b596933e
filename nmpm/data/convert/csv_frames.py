"""Tables with a file per frame: CSV and its relatives, and Parquet, with coordinates in columns x, y, z."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm.data.convert.frame import ARRAY_NAMES, Frame
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.named_arrays import as_dates, as_times
from nmpm.data.convert.tables import Chunk, as_numbers, join_chunks, plain_column, read_chunks, read_columns
from nmpm.data.convert.tracks import USUAL_COLUMNS, coordinate_columns
from nmpm.errors import DataError

_SAME_IN_FRAME = {*USUAL_COLUMNS["frame"], *USUAL_COLUMNS["time"]}


class CsvFrames(FrameFormat):
    """A table per frame; a time or frame in it is the same in all rows."""

    name: ClassVar[str] = "csv-frames"
    summary: ClassVar[str] = "tables with a file per frame (.csv, .tsv, also .gz; .parquet): x, y, z"
    patterns: tuple[str, ...] = ("*.csv", "*.csv.gz", "*.tsv", "*.tsv.gz", "*.parquet")

    def recognises(self, path: Path) -> bool:
        files = next(self._folders(path), (path, []))[1]
        return len(files) > 1 and all(map(_is_frame, files[:2]))

    def frames(self, file: Path) -> Iterator[Frame]:
        names = read_columns(file)
        coordinates = coordinate_columns(names)
        if not coordinates:
            raise DataError(f"{file}: no columns x, y of coordinates (found: {', '.join(names[:12]) or 'no header'}).")
        table = {name: np.zeros(0) for name in names} | join_chunks(list(read_chunks(file, names)))
        columns = [as_numbers(table.pop(name), f"{file}: the column {name}") for name in coordinates]
        position = np.stack(columns, axis=1)
        time = next((table[name] for name in table if plain_column(name) in USUAL_COLUMNS["time"]), np.zeros(0))
        arrays = {_name(name): table[name] for name in table if plain_column(name) not in _SAME_IN_FRAME}
        yield Frame(position, arrays, _first_time(time[:1], f"{file}: its time"))


def _first_time(times: np.ndarray, what: str) -> float | np.datetime64 | None:
    dates = as_dates(times)
    if dates is not None:
        return next(iter(dates), None)
    return next(iter(as_times(times, what).tolist()), None)


def _is_frame(file: Path) -> bool:
    """Whether a table is one frame: it has coordinates, and one time or frame if any."""
    names = read_columns(file)
    keys = [name for name in names if plain_column(name) in _SAME_IN_FRAME]
    chunk: Chunk = next(read_chunks(file, keys), {}) if keys else {}
    return bool(coordinate_columns(names)) and all((values == values[0]).all() for values in chunk.values())


def _name(column: str) -> str:
    """A column's name, without its unit if it is a usual one."""
    plain = plain_column(column)
    return plain if plain in ARRAY_NAMES else column
