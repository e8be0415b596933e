"""Tables with a header, read in chunks of rows: CSV and its relatives, gzipped or not, and Parquet."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from nmpm._support.bounded_files import check_regular
from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm._support.messages import install, one_line
from nmpm._support.progress import progress_bar
from nmpm.data.convert.named_arrays import component_names
from nmpm.data.convert.text_lines import Lines, is_number, open_lines, text_array
from nmpm.data.parquet_columns import column_names, read_batches
from nmpm.errors import ConfigError, DataError

SUFFIXES = ("*.csv", "*.csv.gz", "*.tsv", "*.tsv.gz", "*.txt", "*.txt.gz", "*.parquet")
ROWS = 100_000
"""Rows of a chunk."""
_UNITS = "[nuµμmck]?m|px|pixels?|[nuµμm]?s|sec|kg|g"
_LARGE = 32  # MiB of a file beyond which its progress is shown
_BLOCK = 2**22  # bytes that are parsed at a time

Chunk = Mapping[str, np.ndarray]
"""Columns by name: floats, dates or texts."""


def read_columns(path: Path) -> tuple[str, ...]:
    """Names of a table's columns; none if it has no header."""
    if path.suffix == ".parquet":
        _check_parquet(path)
        return tuple(call_isolated(column_names, path))
    with open_lines(path, "a table") as lines:
        return _header(lines)[0]


def read_chunks(path: Path, columns: Sequence[str]) -> Iterator[Chunk]:
    """Yields some columns of a table, a chunk of rows at a time; text only where a cell is no number.

    Raises:
        DataError: if the file is damaged, or a row has another number of cells; names the file and the line.
        ConfigError: if a package that reads the format is not installed.
    """
    if path.suffix == ".parquet":
        _check_parquet(path)
        for batch in iterate_isolated(read_batches, path, list(columns), ROWS):
            yield {name: _arrow_column(values) for name, values in batch.items()}
        return
    with open_lines(path, "a table") as lines, _progress(path) as advance_to:
        names, delimiter = _header(lines)
        before = lines.number
        while texts := lines.texts(_BLOCK):
            advance_to(lines.stored)
            rows = [line for line in texts if line.strip() and line[0] not in "#%"]
            table = _parse(rows, names, delimiter)
            if table is None:
                raise _cells_error(path, texts, before, len(names), delimiter)
            if table:
                yield {name: table[name] for name in columns}
            before = lines.number


def join_chunks(chunks: Sequence[Chunk]) -> dict[str, np.ndarray]:
    """The columns of all chunks; none where there is no chunk."""
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in (chunks[0] if chunks else ())}


@contextmanager
def _progress(path: Path) -> Iterator[Callable[[int], object]]:
    """A function that shows how many bytes of a large text file are read."""
    total, done = path.stat().st_size // 2**20, 0
    if total < _LARGE:
        yield lambda _: None
        return

    def advance_to(stored: int) -> None:
        nonlocal done
        step(by=stored // 2**20 - done)
        done = stored // 2**20

    with progress_bar(f"Reading {path.name}, MiB", total) as step:
        yield advance_to


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


def as_numbers(values: np.ndarray, what: str) -> np.ndarray:
    """The numbers of a column; raises a DataError, naming what it is, for texts."""
    if values.dtype.kind != "f":
        number = next((index for index, text in enumerate(values.tolist()) if not is_number(text)), 0)
        raise DataError(f"{what} must contain numbers, but has {one_line(str(values[number]), 40)!r}.")
    return values


def _check_parquet(path: Path) -> None:
    check_regular(path)
    if find_spec("pyarrow") is None:
        raise ConfigError(f"{path}: reading Parquet needs pyarrow: {install('tables')}.")


def _arrow_column(values: np.ndarray | list[str]) -> np.ndarray:
    if isinstance(values, list):
        return _column(values, ",")
    if values.dtype.kind == "m":  # durations, in seconds
        return values / np.timedelta64(1, "s")
    return values if values.dtype.kind == "M" else values.astype(np.float64)


def plain_column(name: str) -> str:
    """A column's name in lower case without separators and units: "Position X [mm]" becomes "positionx"."""
    text = re.sub(r"[\[(][^\])]*[\])]", "", name.lower())
    text = re.sub(rf"[\s_.:-]({_UNITS})([/_]({_UNITS}))?$", "", text.strip())
    return re.sub(r"[^a-z0-9]", "", text)


def one_cell(value: object) -> str:
    """A cell of a column as text: numbers without trailing zeros."""
    return f"{value:.15g}" if isinstance(value, float) else str(value)
