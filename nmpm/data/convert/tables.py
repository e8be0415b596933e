"""Tables with a header, read in chunks of rows: CSV and its relatives, gzipped or not, and Parquet.

A table is a frame, or holds tracks, as particle tracking writes them: a row for each particle in each frame, with a
frame or time, an id and coordinates. Names of columns may end in units; a column `run` tells runs apart, whose rows
follow each other. Other columns of numbers become fields. Times on a regular grid of which some are missing have frames
in which nobody is there.
"""

from __future__ import annotations

import csv
import heapq
import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.bounded_files import expansion_limit
from nmpm._support.isolated import call_isolated, iterate_isolated
from nmpm._support.messages import counted, one_line
from nmpm._support.progress import progress_bar
from nmpm.data.convert.base import (
    EVERYTHING_UNKNOWN,
    Facts,
    Options,
    Run,
    RunFiles,
    located,
    needs,
    placeholder_metadata,
)
from nmpm.data.convert.frame_files import FrameFormat
from nmpm.data.convert.frames import ARRAY_NAMES, Frame
from nmpm.data.convert.named_arrays import (
    AXES,
    CONSTANT,
    USUAL_NAMES,
    as_dates,
    as_times,
    component_names,
    constant_axis,
    drop_axis,
    in_plane,
    plane_notes,
    type_ids,
)
from nmpm.data.convert.text_frames import Lines, is_number, open_lines, text_array
from nmpm.data.format import ID, TRACK, Metadata, Trajectory
from nmpm.errors import DataError, NmpmError

_log = logging.getLogger(__name__)

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
_JITTER = 0.1  # of the time between frames
_GAPS = 4  # frames of a regular grid per frame that is there
_SPARSE = 4  # entries of (T, ids) arrays per row, beyond which tracks share slots

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
            chunk = dict[str, np.ndarray]()
            for name, values in batch.items():
                if isinstance(values, list):
                    chunk[name] = _column(values, ",")
                else:
                    chunk[name] = values if values.dtype.kind == "M" else as_times(values, "a column")
            yield chunk
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
        if named and coordinate_columns(names):
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
        def is_frame(file: Path) -> bool:  # it has coordinates, and one time or frame if any
            names = read_columns(file)
            keys = [name for name in names if plain_column(name) in _SAME_IN_FRAME]
            chunk: Chunk = next(read_chunks(file, keys), {}) if keys else {}
            return bool(coordinate_columns(names)) and all((values == values[0]).all() for values in chunk.values())

        files = self.first_files(path)
        return len(files) > 1 and all(map(is_frame, files[:2]))

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


@dataclass(frozen=True)
class Columns:
    """Names of the columns of a table of tracks."""

    roles: Mapping[str, str]  # by what they mean, as `USUAL_COLUMNS`
    position: tuple[str, ...]
    velocity: tuple[str, ...]
    key: str  # by which rows are in the same frame
    others: tuple[str, ...]  # without a meaning


def table_columns(file: Path) -> Columns:
    """The columns of a table of tracks; a DataError that names the file and what is missing if it is none."""
    names = read_columns(file)
    plain = {plain_column(name): name for name in reversed(names)}
    roles = {
        meaning: next(plain[name] for name in usual if name in plain)
        for meaning, usual in USUAL_COLUMNS.items()
        if not plain.keys().isdisjoint(usual)
    }
    if "track" not in roles and "run" in roles:  # tracks are called trajectories too
        roles["track"] = roles.pop("run")
    position, velocity = component_names(plain, "position"), component_names(plain, "velocity")
    key = roles.get("frame") or roles.get("time") or ""
    needed = {"id": roles.get("track"), "coordinates x, y": position, "frame or time": key}
    if missing := [what for what, column in needed.items() if not column]:
        columns = f"no column {' and no column '.join(missing)} (columns: {', '.join(names[:12])})"
        problem = columns if names else "it has no header with names of columns"
        raise DataError(f"{file}: it is no table of tracks: {problem}.")
    velocity = velocity if len(velocity) == len(position) else ()
    used = {*roles.values(), *position, *velocity}
    return Columns(roles, position, velocity, key, tuple(name for name in names if name not in used))


class Tracks(RunFiles):
    """Tables of tracks; particles that are in no row of a frame are absent in it."""

    summary: ClassVar[str] = "tables of tracks (.csv, .tsv, .txt, .gz, .parquet): frame or time, id, x, y, z"
    patterns: tuple[str, ...] = SUFFIXES

    def recognises(self, path: Path) -> bool:
        first = next(iter(self.files(path).values()), ())[:1]
        try:
            return any(table_columns(file) for file in first)
        except (NmpmError, OSError):
            return any(file.suffix == ".parquet" for file in first)

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        def may_be_table(file: Path) -> bool:
            with suppress(DataError):
                return ".txt" not in file.suffixes or bool(read_columns(file))
            return False

        files = super().files(path)
        if path.is_dir():  # text files of other content are not tables
            files = {split: tuple(filter(may_be_table, inside)) for split, inside in files.items()}
        return {split: inside for split, inside in files.items() if inside}

    def runs(self, file: Path) -> Sequence[Run]:
        column = table_columns(file).roles.get("run")
        if column is None:
            return [Run(file, 0)]
        names = [chunks[0][column][0] for chunks in _split_runs(read_chunks(file, [column]), column)]
        for name, count in Counter(names).items():
            if count > 1:
                rows = f"the rows of {column} {one_cell(name)}"
                raise DataError(f"{file}: {rows} do not follow each other. Sort the table by {column}.")
        return [Run(file, index) for index in range(len(names))]

    def facts(self, file: Path, options: Options) -> Facts:  # noqa: ARG002
        columns = table_columns(file)
        types, coordinates = columns.roles.get("types"), columns.position if len(columns.position) == len(AXES) else ()
        wanted = [*coordinates, *([types] if types else [])]
        ends, names = [np.zeros((0, len(coordinates)))], set[str]()
        for chunk in read_chunks(file, wanted) if wanted else ():
            if coordinates and all(chunk[name].dtype.kind == "f" for name in coordinates):
                position = np.stack([chunk[name] for name in coordinates], axis=-1)
                ends += [np.fmin.reduce(position)[None], np.fmax.reduce(position)[None]]
            if types and chunk[types].dtype.kind == "U":
                names.update(np.unique(chunk[types]).tolist())
        constant = constant_axis(np.concatenate(ends))
        shown = f"{columns.key}, {columns.roles['track']}, {', '.join(columns.position)}"
        fields = f"; as fields, where they are numbers: {', '.join(columns.others)}" if columns.others else ""
        extra = {CONSTANT: constant} if constant else {}
        dim = len(columns.position) - len(constant)
        metadata = placeholder_metadata(dim, particle_types=dict(enumerate(sorted(names))), extra=extra)
        unknown = EVERYTHING_UNKNOWN - ({"particle_types"} if names else set())
        return Facts(metadata, unknown, (f"Columns: {shown}{fields}.", *plane_notes(constant)))

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        columns, row = table_columns(file), 1
        run = columns.roles.get("run")
        names = [*columns.roles.values(), *columns.position, *columns.velocity, *columns.others]
        for index, chunks in enumerate(_split_runs(read_chunks(file, names), run)):
            where = f"{file}, run {index}" if run else str(file)
            if index in set(indices):
                yield _track_rows(join_chunks(chunks), columns, metadata, where, row).trajectory(where)
            if index == max(indices):
                return
            row += sum(len(chunk[columns.key]) for chunk in chunks)


def _track_rows(table: Chunk, columns: Columns, metadata: Metadata, where: str, first_row: int) -> TrackRows:
    """The rows of a run; those without an id or position are left out, the first with a warning."""
    roles = columns.roles
    key = as_times(table[columns.key], f"{where}: the column {columns.key}")
    time = as_times(table[roles["time"]], f"{where}: the column {roles['time']}") if "time" in roles else None
    constant, track = metadata.extra.get(CONSTANT, {}), table[roles["track"]]
    with located(where):
        position = number_columns(table, columns.position)
        active = number_columns(table, [roles["active"]])[:, 0] if "active" in roles else np.ones(len(key))
    position = in_plane(position, metadata.dim, constant, where)
    if not np.isin(active, (0, 1)).all():
        raise DataError(f"{where}: {roles['active']} must be 0 where a particle is absent, and 1 elsewhere.")
    unlinked = np.isnan(track) if track.dtype.kind == "f" else track == ""
    keep = ~(unlinked | np.isnan(key) | np.isnan(position).any(axis=1)) & (active == 1)
    if unlinked.any():
        _log.warning("%s: %s without %s left out.", where, counted(int(unlinked.sum()), "row"), roles["track"])
    if not keep.any():
        raise DataError(f"{where}: no row has an id, a frame and a position.")
    types = table[roles["types"]] if "types" in roles else np.zeros(len(track))
    if types.dtype.kind == "f":
        types = np.nan_to_num(types).astype(np.int64)
    else:
        types = type_ids(types, {name: i for i, name in metadata.particle_types.items()}, where)
    velocity = drop_axis(np.array(columns.velocity), constant).tolist() if columns.velocity else []
    return TrackRows(
        row=first_row + np.flatnonzero(keep),
        position=position[keep],
        track=track[keep],
        key=key[keep],
        time=None if time is None else time[keep],
        types=types[keep],
        values={name: table[name][keep] for name in columns.others if table[name].dtype.kind == "f"},
        velocity=np.stack([table[name][keep] for name in velocity], axis=-1) if velocity else None,
    )


def _split_runs(chunks: Iterable[Chunk], column: str | None) -> Iterator[list[Chunk]]:
    """Yields the chunks of each run, whose rows follow each other; of the only one without such a column."""
    pending: list[Chunk] = []
    for chunk in chunks:
        if column is None:
            pending.append(chunk)
            continue
        names = chunk[column]
        edges = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names)]
        for low, high in pairwise(edges):
            if pending and pending[-1][column][-1] != names[low]:
                yield pending
                pending = []
            pending.append({name: values[low:high] for name, values in chunk.items()})
    if pending:
        yield pending


@dataclass(frozen=True)
class TrackRows:
    """Rows of one run: a position of a track in a frame each."""

    row: np.ndarray  # (n,) numbers of the rows in the table, for messages
    position: np.ndarray  # (n, D)
    track: np.ndarray  # (n,) ids, numbers or texts
    key: np.ndarray  # (n,) frame numbers, or times where there are none
    time: np.ndarray | None  # (n,)
    types: np.ndarray  # (n,) type ids
    values: Mapping[str, np.ndarray]  # (n,) other numbers by name
    velocity: np.ndarray | None  # (n, D)

    def trajectory(self, where: str) -> Trajectory:
        """The run with a particle for each track, or slots that hold one track after the other.

        Tracks share slots where most of a (T, tracks) array would be empty: a slot holds tracks of one type, with at
        least one absent frame between them, and the field `track` tells them apart; else the field `id` has the track
        of each particle. Other columns become fields (T, N),
        where a particle is absent with the value before (or after) that; (N,) if they are constant.

        Raises:
            DataError: if a track has two rows in a frame or changes its type; names the rows.
        """
        frame_of, frames = frame_numbers(self.key)
        ids, track = np.unique(self.track, return_inverse=True)
        ids = np.char.encode(ids, "utf-8") if ids.dtype.kind == "U" else ids
        ids = ids.astype(np.int64) if ids.dtype.kind != "S" and (ids == np.round(ids)).all() else ids
        order = np.lexsort((frame_of, track))
        same = (np.diff(track[order]) == 0) & (np.diff(frame_of[order]) == 0)
        if same.any():
            start = int(np.argmax(same))
            one, other = sorted(order[start : start + 2].tolist())
            raise DataError(
                f"{where}: rows {self.row[one]} and {self.row[other]} are both track {one_cell(self.track[one])} in"
                f" frame {frame_of[one]} (at {self.key[one]:g}). Remove one, or state the run of each in a column run."
            )
        types = np.zeros(len(ids), np.int64)
        types[track] = self.types
        if (changes := types[track] != self.types).any():
            index = int(np.argmax(changes))
            raise DataError(f"{where}: track {one_cell(self.track[index])} changes its type in row {self.row[index]}.")
        slot_of = np.arange(len(types))
        shared = len(types) * frames > _SPARSE * len(track)
        if shared:
            slot_of = assign_slots(track, frame_of, types)
        slot, count = slot_of[track], int(slot_of.max()) + 1

        def placed(values: np.ndarray, absent: Any = np.nan, dtype: Any = np.float32) -> np.ndarray:
            array = np.full((frames, count, *values.shape[1:]), absent, dtype)
            array[frame_of, slot] = values
            return array

        kinds = np.zeros(count, np.int64)
        kinds[slot_of] = types
        position = placed(self.position)
        present = ~np.isnan(position[..., 0])
        last = np.maximum.accumulate(np.where(present, np.arange(frames)[:, None], -1), axis=0)
        last, fields = np.where(last < 0, present.argmax(axis=0), last), dict[str, np.ndarray]()
        for name, values in self.values.items():
            filled = np.take_along_axis(placed(values), last, axis=0)
            fields[name] = filled[0] if (filled == filled[0]).all() else filled
        if not shared:
            fields[ID] = ids
        elif ids.dtype.kind != "i" or ids[0] < 0:
            fields |= {ID: placed(ids[track], ids.dtype.type(), ids.dtype), TRACK: placed(track, -1, np.int64)}
        else:
            fields[TRACK] = placed(ids[track], -1, np.int64)
        if self.velocity is not None:
            fields["velocity"] = placed(self.velocity)
        if self.time is not None:
            with_rows, first = np.unique(frame_of, return_index=True)
            fields["time"] = np.interp(np.arange(frames), with_rows, self.time[first])
        return Trajectory(position, kinds, {}, fields)


def frame_numbers(key: np.ndarray) -> tuple[np.ndarray, int]:
    """(n,) indices of the frames of rows, and the number of frames.

    Frame numbers or times on a regular grid have a frame at each of its points, also where no row is; others have one
    for each value.
    """
    values, index = np.unique(key, return_inverse=True)
    if len(values) < 2:
        return index, len(values)
    steps = np.diff(values)
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    for _ in range(2):  # with a better step
        grid = np.round((values - values[0]) / step).astype(np.int64)
        step = float((values[-1] - values[0]) / max(grid[-1], 1))
    regular = np.abs(values - values[0] - grid * step).max() <= _JITTER * step and (np.diff(grid) > 0).all()
    if regular and grid[-1] < _GAPS * len(values):
        return grid[index], int(grid[-1]) + 1
    return index, len(values)


def assign_slots(track: np.ndarray, frame_of: np.ndarray, types: np.ndarray) -> np.ndarray:
    """(tracks,) the fewest slots, so that tracks in a slot have the same type and an absent frame between them."""
    first, last = np.full(len(types), np.iinfo(np.int64).max), np.full(len(types), -1)
    np.minimum.at(first, track, frame_of)
    np.maximum.at(last, track, frame_of)
    slots, count = np.empty(len(types), np.int64), 0
    free: dict[int, list[tuple[int, int]]] = {}  # by type: last frame and slot
    for index in np.argsort(first, kind="stable").tolist():
        ends = free.setdefault(int(types[index]), [])
        if ends and ends[0][0] + 1 < first[index]:
            _, slot = heapq.heappop(ends)
        else:
            slot, count = count, count + 1
        slots[index] = slot
        heapq.heappush(ends, (int(last[index]), slot))
    return slots
