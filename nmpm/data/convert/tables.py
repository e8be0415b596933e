"""Tables with a header, read in chunks of rows: CSV and its relatives, gzipped or not, and Parquet; a table per frame.

Names of columns may end in units.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.bounded_files import expansion_limit
from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm._support.messages import one_line
from nmpm._support.progress import progress_bar
from nmpm.data.convert.base import located, needs
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import ARRAY_NAMES, Frame
from nmpm.data.convert.named_arrays import USUAL_NAMES, as_dates, as_times, component_names
from nmpm.data.convert.text_frames import Lines, is_number, open_lines, text_array
from nmpm.errors import DataError

SUFFIXES = ("*.csv", "*.csv.gz", "*.tsv", "*.tsv.gz", "*.txt", "*.txt.gz", "*.parquet")
ROWS = 100_000
"""Rows of a chunk."""
USUAL_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "frame": (
        "frame", "frames", "framenumber", "frameindex", "frameid", "framenr", "step", "timestep", "iteration", "image",
    ),
    "time": ("time", "times", "t", "timestamp", "positiont", "seconds"),
    "track": (
        "track", "trackid", "tracknumber", "particle", "particleid", "pid", "id", "ids", "object", "objectid", "label",
    ),
    "run": (
        "run", "runid", "trajectory", "trajectoryid", "traj", "experiment", "experimentid", "simulation", "sim", "case",
    ),
    "types": ("type", "types", "particletype", "material", "materialid", "phase", "species", "kind", "class"),
    "active": USUAL_NAMES["active"],
}  # fmt: skip
"""Names of columns by what they mean, in lower case without separators and units."""
_UNITS = "[nuµμmck]?m|px|pixels?|[nuµμm]?s|sec|kg|g"
_VALUE_BYTES = 8
_LARGE = 32  # MiB of a file beyond which its progress is shown
_BLOCK = 2**22  # bytes that are parsed at a time

Chunk = Mapping[str, np.ndarray]
"""Columns by name: floats, dates or texts."""


def read_columns(path: Path) -> tuple[str, ...]:
    """Names of a table's columns; none if it has no header."""
    if path.suffix == ".parquet":
        needs(path, "Parquet", "pyarrow", "tables")
        return tuple(call_isolated(parquet_columns, path))
    with open_lines(path, "a table") as lines:
        return _header(lines)[0]


def read_chunks(path: Path, columns: Sequence[str]) -> Iterator[Chunk]:
    """Yields some columns of a table, a chunk of rows at a time; text only where a cell is no number.

    Raises:
        DataError: if the file is damaged, or a row has another number of cells; names the file and the line.
        ConfigError: if a package that reads the format is not installed.
    """
    if path.suffix == ".parquet":
        needs(path, "Parquet", "pyarrow", "tables")
        for batch in iterate_isolated(parquet_batches, path, list(columns), ROWS):
            yield {name: _arrow_column(values) for name, values in batch.items()}
        return
    size, done = path.stat().st_size // 2**20, 0
    with (
        open_lines(path, "a table") as lines,
        progress_bar(f"Reading {path.name}, MiB", size) if size >= _LARGE else nullcontext() as advance,
    ):
        names, delimiter = _header(lines)
        before = lines.number
        while texts := lines.texts(_BLOCK):
            if advance is not None:
                advance(by=lines.stored // 2**20 - done)
                done = lines.stored // 2**20
            rows = [line for line in texts if line.strip() and line[0] not in "#%"]
            table = _parse(rows, names, delimiter)
            if table is None:
                raise _cells_error(path, texts, before, len(names), delimiter)
            if table:
                yield {name: table[name] for name in columns}
            before = lines.number


def parquet_columns(path: Path) -> list[str]:
    """Names of the columns of a Parquet file; for child processes, as Arrow crashes on damaged files."""
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        return list(map(str, file.schema_arrow.names))


def parquet_batches(path: Path, columns: Sequence[str], rows: int) -> Iterator[dict[str, np.ndarray | list[str]]]:
    """Yields some columns of a Parquet file, so many rows at a time: numbers, dates, or texts ("" for no value).

    Raises:
        DataError: if the file declares far more values than it stores.
    """
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        count, size = file.metadata.num_rows, path.stat().st_size
        if count * len(file.schema_arrow.names) * _VALUE_BYTES > expansion_limit(size):
            raise DataError(f"{path}: it declares {count:,} rows but has {size:,} bytes. Is it complete?")
        for batch in file.iter_batches(batch_size=rows, columns=list(columns), use_threads=False):
            arrays = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in columns}
            yield {
                name: values
                if values.dtype.kind in "biufmM"
                else ["" if item is None else str(item) for item in values.tolist()]
                for name, values in arrays.items()
            }


def _arrow_column(values: np.ndarray | list[str]) -> np.ndarray:
    if isinstance(values, list):
        return _column(values, ",")
    return values if values.dtype.kind == "M" else as_times(values, "a column")


def join_chunks(chunks: Sequence[Chunk]) -> dict[str, np.ndarray]:
    """The columns of all chunks; none where there is no chunk."""
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in (chunks[0] if chunks else ())}


def _parse(rows: list[str], names: Sequence[str], delimiter: str | None) -> Chunk | None:
    """The columns of some rows; empty where there are none, None if rows have other numbers of cells."""
    try:
        numbers = np.loadtxt(rows, delimiter=delimiter, comments=None, quotechar='"', ndmin=2) if rows else np.empty(0)
        if numbers.ndim == 2 and numbers.shape[1] == len(names):
            return dict(zip(names, numbers.T, strict=True))
    except ValueError:  # texts, empty cells
        pass
    cells = (
        [_split(row, delimiter) for row in rows] if delimiter is None else list(csv.reader(rows, delimiter=delimiter))
    )
    while cells and not any(map(is_number, cells[0])):  # labels and units below the header have no numbers
        cells.pop(0)
    if any(len(row) != len(names) for row in cells):
        return None
    return {name: _column([row[index] for row in cells], delimiter) for index, name in enumerate(names) if cells}


def _cells_error(path: Path, lines: list[str], first: int, count: int, delimiter: str | None) -> DataError:
    """The error on the first row with another number of cells than the header."""
    for number, line in enumerate(lines, start=first + 1):
        cells = len(_split(line, delimiter)) if line.strip() and line[0] not in "#%" else count
        if cells != count:
            commas = delimiter == "," and re.search(r"\d,\d", line) is not None and cells > count
            mend = " If commas are decimal, separate cells by semicolons." if commas else ""
            return DataError(f"{path}, line {number}: it has {cells} cells, the header has {count}.{mend}")
    return DataError(f"{path}: rows have another number of cells than the header, {count}.")


def _header(lines: Lines) -> tuple[tuple[str, ...], str | None]:
    """Names of columns, and the delimiter (None for blanks), which a first line such as "sep=;" may state.

    They are in the first line with text, or in a later one that has coordinates, below facts of the whole file.
    """
    stated, first = None, None
    for _ in range(100):
        text = lines.next().strip().lstrip("#%").strip()
        if spreadsheet := re.fullmatch('"?sep=(.?)"?', text, re.IGNORECASE):
            stated = spreadsheet[1] or "\t"
            continue
        if not text:
            continue
        delimiter = stated or next((sign for sign in "\t;," if sign in text), None)
        names = [name or f"column {index}" for index, name in enumerate(_split(text, delimiter))]  # pandas' index
        named = len(set(names)) == len(names) > 1 and not any(map(is_number, names))
        if named and component_names({plain_column(name): name for name in names}, "position"):
            return tuple(names), delimiter
        first = first or (tuple(names) if named else (), delimiter)
    return first or ((), None)


def _split(text: str, delimiter: str | None) -> list[str]:
    cells = text.split() if delimiter is None else next(csv.reader([text], delimiter=delimiter))
    return [cell.strip().strip('"') for cell in cells]


def _column(cells: list[str], delimiter: str | None) -> np.ndarray:
    """Numbers, also logical ones, NaN for empty cells; texts if a cell is none of these.

    Decimal commas are points where cells have another delimiter.
    """
    texts = text_array(cells)
    try:
        return texts.astype(np.float64)
    except ValueError:
        pass
    texts = np.char.strip(texts)
    numbers = np.where(np.isin(texts, ("", "NA", "N/A", "null", "None", "-")), "nan", texts)
    words = np.char.lower(numbers)
    if np.isin(words, ("true", "false", "nan")).all():
        numbers = np.where(words == "true", "1", np.where(words == "false", "0", "nan"))
    if delimiter != ",":
        numbers = np.char.replace(numbers, ",", ".")
    try:
        return numbers.astype(np.float64)
    except ValueError:
        return texts


def number_columns(table: Chunk, names: Sequence[str]) -> np.ndarray:
    """Some columns as (n, columns) numbers; raises a DataError for texts."""
    for name in names:
        if table[name].dtype.kind != "f":
            text = next((text for text in table[name].tolist() if not is_number(text)), table[name][0])
            raise DataError(f"the column {name} must contain numbers, but has {one_line(str(text), 40)!r}.")
    return np.stack([table[name] for name in names], axis=-1)


def plain_column(name: str) -> str:
    """A column's name in lower case without separators and units: "Position X [mm]" becomes "positionx"."""
    text = re.sub(r"[\[(][^\])]*[\])]", "", name.lower())
    text = re.sub(rf"[\s_.:-]({_UNITS})([/_]({_UNITS}))?$", "", text.strip())
    return re.sub(r"[^a-z0-9]", "", text)


def one_cell(value: object) -> str:
    """A cell of a column as text: numbers without trailing zeros."""
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def coordinate_columns(names: Sequence[str]) -> tuple[str, ...]:
    """The columns of the coordinates x, y and z, as far as there are."""
    return component_names({plain_column(name): name for name in reversed(names)}, "position")


def table_frame(table: Chunk) -> Frame:
    """The particles of a frame, a row each; raises a DataError if there are no coordinates."""
    names = coordinate_columns(list(table))
    if not names:
        found = ", ".join(list(table)[:12]) or "no header"
        raise DataError(f"no columns x, y of coordinates (found: {found}).")
    arrays = {
        plain if (plain := plain_column(name)) in ARRAY_NAMES else name: values
        for name, values in table.items()
        if name not in names
    }
    return Frame(number_columns(table, names), arrays)


_SAME_IN_FRAME = {*USUAL_COLUMNS["frame"], *USUAL_COLUMNS["time"]}


class CsvFrames(FrameFormat):
    """A table per frame; a time or frame in it is the same in all rows."""

    summary: ClassVar[str] = "tables with a file per frame (.csv, .tsv, also .gz; .parquet): x, y, z"
    patterns: tuple[str, ...] = ("*.csv", "*.csv.gz", "*.tsv", "*.tsv.gz", "*.parquet")

    def recognises(self, path: Path) -> bool:
        files = next(self._folders(path), (path, []))[1]
        return len(files) > 1 and all(map(_is_frame, files[:2]))

    def frames(self, file: Path) -> Iterator[Frame]:
        names = read_columns(file)
        table = {name: np.zeros(0) for name in names} | join_chunks(list(read_chunks(file, names)))
        with located(file):
            frame = table_frame(table)
            arrays = {n: v for n, v in frame.arrays.items() if plain_column(n) not in _SAME_IN_FRAME}
            times = next((table[name] for name in table if plain_column(name) in USUAL_COLUMNS["time"]), np.zeros(0))
            dates = as_dates(times[:1])
            first = as_times(times[:1], "its time").tolist() if dates is None else list(dates)
        yield replace(frame, arrays=arrays, time=next(iter(first), None))


def _is_frame(file: Path) -> bool:
    """Whether a table is one frame: it has coordinates, and one time or frame if any."""
    names = read_columns(file)
    keys = [name for name in names if plain_column(name) in _SAME_IN_FRAME]
    chunk: Chunk = next(read_chunks(file, keys), {}) if keys else {}
    return bool(coordinate_columns(names)) and all((values == values[0]).all() for values in chunk.values())
