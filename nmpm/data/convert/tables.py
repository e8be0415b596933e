"""Tables with a header, read in chunks of rows: CSV and its relatives, gzipped or not, and Parquet."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from nmpm._support.bounded_files import check_regular, expansion_limit
from nmpm._support.messages import one_line
from nmpm._support.progress import progress_bar
from nmpm.errors import ConfigError, DataError, NmpmError

SUFFIXES = ("*.csv", "*.csv.gz", "*.tsv", "*.tsv.gz", "*.txt", "*.txt.gz", "*.parquet")
ROWS = 100_000
"""Rows of a chunk."""
_UNITS = "[nuµμmck]?m|px|pixels?|[nuµμm]?s|sec|kg|g"
_LARGE = 32  # MiB of a file beyond which its progress is shown
_LINE = 2**16  # characters of a line
_BLOCK = 2**22  # characters that are parsed at a time

Chunk = Mapping[str, np.ndarray]
"""Columns by name, floats or texts."""


def read_columns(path: Path) -> tuple[str, ...]:
    """Names of a table's columns; none if it has no header."""
    if path.suffix == ".parquet":
        with _open_parquet(path) as file:
            return tuple(map(str, file.schema_arrow.names))
    with _open_text(path) as file:
        return _header(file)[0]


def read_chunks(path: Path, columns: Sequence[str]) -> Iterator[Chunk]:
    """Yields some columns of a table, a chunk of rows at a time; text only where a cell is no number.

    Raises:
        DataError: if the file is damaged, or a row has another number of cells; names the file and the line.
        ConfigError: if a package that reads the format is not installed.
    """
    if path.suffix == ".parquet":
        with _open_parquet(path) as file:
            for batch in file.iter_batches(batch_size=ROWS, columns=list(columns)):
                yield {name: _arrow_column(batch.column(name)) for name in columns}
        return
    limit = expansion_limit(path.stat().st_size)
    with _open_text(path) as file, _progress(path) as advance_to:
        names, delimiter, number = _header(file)
        for lines in _blocks(file):
            advance_to(file)
            if path.suffix == ".gz" and file.buffer.tell() > limit:
                raise DataError(f"{path}: unpacks to more than {limit:,} bytes.")
            rows = [line for line in lines if line.strip() and line[0] not in "#%"]
            table = _parse(rows, names, delimiter)
            if table is None:
                raise _cells_error(path, lines, number, len(names), delimiter)
            if table:
                yield {name: table[name] for name in columns}
            number += len(lines)


@contextmanager
def _progress(path: Path) -> Iterator[Callable[[Any], object]]:
    """A function that shows how much of a large text file is read, of which the open file is its argument."""
    total, done = path.stat().st_size // 2**20, 0
    if total < _LARGE:
        yield lambda _: None
        return

    def advance_to(file: Any) -> None:
        nonlocal done
        now = getattr(file.buffer, "fileobj", file.buffer).tell() // 2**20  # of what is stored
        step(by=now - done)
        done = now

    with progress_bar(f"Reading {path.name}, MiB", total) as step:
        yield advance_to


def _blocks(file: TextIO) -> Iterator[list[str]]:
    """Yields the lines of a file, many at a time."""
    while text := file.read(_BLOCK):
        if not text.endswith("\n"):
            text += file.readline(_LINE)
        yield text.replace("\r", "").removesuffix("\n").split("\n")


def _parse(rows: list[str], names: Sequence[str], delimiter: str | None) -> Chunk | None:
    """The columns of some rows; empty where there are none, None if rows have other numbers of cells."""
    try:
        numbers = np.loadtxt(rows, delimiter=delimiter, comments=None, quotechar='"', ndmin=2) if rows else np.empty(0)
        if numbers.ndim == 2 and numbers.shape[1] == len(names):
            return dict(zip(names, numbers.T, strict=True))
    except ValueError:  # texts, empty cells
        pass
    cells = [row.split() for row in rows] if delimiter is None else list(csv.reader(rows, delimiter=delimiter))
    while cells and not any(map(_is_number, cells[0])):  # labels and units below the header have no numbers
        cells.pop(0)
    if any(len(row) != len(names) for row in cells):
        return None
    return {name: _column([row[index] for row in cells]) for index, name in enumerate(names) if cells}


def _cells_error(path: Path, lines: list[str], first: int, count: int, delimiter: str | None) -> DataError:
    """The error on the first row with another number of cells than the header."""
    for number, line in enumerate(lines, start=first + 1):
        cells = len(_split(line, delimiter)) if line.strip() and line[0] not in "#%" else count
        if cells != count:
            return DataError(f"{path}, line {number}: it has {cells} cells, the header has {count}.")
    return DataError(f"{path}: rows have another number of cells than the header, {count}.")


def _header(file: TextIO) -> tuple[tuple[str, ...], str | None, int]:
    """Names of columns, the delimiter (None for blanks), and the number of the header's line."""
    for number, line in enumerate(islice(iter(lambda: file.readline(_LINE), ""), 100), start=1):
        text = line.strip().lstrip("\ufeff#%").strip()
        if not text:
            continue
        delimiter = next((sign for sign in "\t;," if sign in text), None)
        names = [name or f"column {index}" for index, name in enumerate(_split(text, delimiter))]  # pandas' index
        named = len(set(names)) == len(names) and not any(map(_is_number, names))
        return (tuple(names) if named and len(names) > 1 else (), delimiter, number)
    return (), None, 0


def _split(text: str, delimiter: str | None) -> list[str]:
    cells = text.split() if delimiter is None else next(csv.reader([text], delimiter=delimiter))
    return [cell.strip().strip('"') for cell in cells]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _column(cells: list[str]) -> np.ndarray:
    """Numbers, NaN for empty cells; texts if a cell is no number."""
    texts = np.array(cells)
    try:
        return texts.astype(np.float64)
    except ValueError:
        pass
    texts = np.char.strip(texts)
    try:
        return np.where(np.isin(texts, ("", "NA", "N/A", "null", "None", "-")), "nan", texts).astype(np.float64)
    except ValueError:
        return texts


@contextmanager
def _open_text(path: Path) -> Iterator[TextIO]:
    """The text of a file that may be gzipped; errors name the file."""
    check_regular(path)
    try:
        opener: Any = gzip.open if path.suffix == ".gz" else open
        with opener(path, "rt", encoding="utf-8", errors="replace", newline="") as file:
            yield file
    except NmpmError:
        raise
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise DataError(f"{path}: cannot be read ({one_line(error)}). Is it complete? Copy it again.") from error


@contextmanager
def _open_parquet(path: Path) -> Iterator[Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError(f'{path}: reading Parquet needs pyarrow: pip install "nmpm[tables]".') from error
    check_regular(path)
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            yield file
    except NmpmError:
        raise
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as Parquet ({one_line(error)}). Copy it again.") from error


def _arrow_column(column: Any) -> np.ndarray:
    values = np.asarray(column.to_numpy(zero_copy_only=False))
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    if values.dtype.kind in "mM":
        return (
            values.astype("datetime64[ns]" if values.dtype.kind == "M" else "timedelta64[ns]").astype(np.int64) * 1e-9
        )
    return _column(["" if item is None else str(item) for item in values.tolist()])


def plain_column(name: str) -> str:
    """A column's name in lower case without separators and units: "Position X [mm]" becomes "positionx"."""
    text = re.sub(r"[\[(][^\])]*[\])]", "", name.lower())
    text = re.sub(rf"[\s_.:-]({_UNITS})([/_]({_UNITS}))?$", "", text.strip())
    return re.sub(r"[^a-z0-9]", "", text)


def one_cell(value: object) -> str:
    """A cell of a column as text: numbers without trailing zeros."""
    return f"{value:.15g}" if isinstance(value, float) else str(value)
