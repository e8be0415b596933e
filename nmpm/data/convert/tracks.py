"""Tables of tracks: a row for each particle in each frame, with a frame or time, an id and coordinates.

As particle tracking writes them. Names of columns may end in units; a column `run` tells runs apart, whose rows follow
each other. Other columns of numbers become fields. Times on a regular grid of which some are missing have frames in
which nobody is there.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.convert.run_files import EVERYTHING_UNKNOWN, Run, RunFiles, placeholder_metadata
from nmpm.data.convert.tables import SUFFIXES, Chunk, one_cell, plain_column, read_chunks, read_columns
from nmpm.data.convert.track_rows import TrackRows, frame_numbers
from nmpm.data.format import Metadata, Trajectory
from nmpm.errors import DataError, NmpmError

_log = logging.getLogger(__name__)

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
}  # fmt: skip
"""Names of columns by what they mean, in lower case without separators and units."""
_POSITION = tuple(f"{name}{{axis}}" for name in ("", "pos", "position", "coord", "coordinates", "points", "centroid"))
_VELOCITY = ("v{axis}", "vel{axis}", "velocity{axis}")
_AXES = ("xyz", "012")


@dataclass(frozen=True)
class Columns:
    """Names of a table's columns by what they mean.

    Args:
        names: All of them.

    Raises:
        DataError: if there are no tracks in the table; the message says what is missing.
    """

    names: Sequence[str]
    frame: str | None = field(init=False)
    time: str | None = field(init=False)
    track: str = field(init=False)
    run: str | None = field(init=False)
    types: str | None = field(init=False)
    position: tuple[str, ...] = field(init=False)
    velocity: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        plain = {plain_column(name): name for name in reversed(self.names)}
        parts: dict[str, Any] = {key: _first(plain, usual) for key, usual in USUAL_COLUMNS.items()}
        parts["position"] = _components(plain, _POSITION)
        velocity = _components(plain, (*_VELOCITY, "{letter}"))
        parts["velocity"] = velocity if len(velocity) == len(parts["position"]) else ()
        if parts["track"] is None and parts["run"] is not None:  # tracks are called trajectories too
            parts |= {"track": parts["run"], "run": None}
        needed = {
            "id": parts["track"],
            "coordinates x, y": parts["position"],
            "frame or time": parts["frame"] or parts["time"],
        }
        missing = [what for what, column in needed.items() if not column]
        if not self.names:
            raise DataError("it has no header with names of columns.")
        if missing:
            raise DataError(f"no column {' and no column '.join(missing)} (columns: {', '.join(self.names[:12])}).")
        for key, value in parts.items():
            object.__setattr__(self, key, value)

    @property
    def key(self) -> str:
        """The column by which rows are in the same frame."""
        return self.frame or self.time or ""

    @property
    def used(self) -> tuple[str, ...]:
        """Columns with a meaning."""
        single = (self.frame, self.time, self.track, self.run, self.types)
        return (*(name for name in single if name is not None), *self.position, *self.velocity)


def coordinate_columns(names: Sequence[str]) -> tuple[str, ...]:
    """The columns of the coordinates x, y and z, as far as there are."""
    return _components({plain_column(name): name for name in reversed(names)}, _POSITION)


def _first(plain: Mapping[str, str], usual: Iterable[str]) -> str | None:
    return next((plain[name] for name in usual if name in plain), None)


def _components(plain: Mapping[str, str], patterns: Iterable[str]) -> tuple[str, ...]:
    """The columns of two or three coordinates; () if there are none."""
    for pattern in patterns:
        for axes in _AXES:
            letters = zip(axes, "uvw", strict=True)
            names = [plain.get(pattern.format(axis=axis, letter=letter)) for axis, letter in letters]
            present = tuple(name for name in names if name is not None)
            if len(present) > 1 and names[: len(present)] == list(present):
                return present
    return ()


class Tracks(RunFiles):
    """Tables of tracks; particles that are in no row of a frame are absent in it."""

    name: ClassVar[str] = "tracks"
    summary: ClassVar[str] = "tables of tracks (.csv, .tsv, .txt, .gz, .parquet): frame or time, id, x, y, z"
    patterns: ClassVar[tuple[str, ...]] = SUFFIXES

    def recognises(self, path: Path) -> bool:
        first = next(iter(self.files(path).values()), ())[:1]
        try:
            return any(table_columns(file) for file in first)
        except (NmpmError, OSError):
            return any(file.suffix == ".parquet" for file in first)

    def files(self, path: Path) -> dict[str, tuple[Path, ...]]:
        files = super().files(path)
        if path.is_dir():  # text files of other content are not tables
            files = {split: tuple(filter(_may_be_table, inside)) for split, inside in files.items()}
        return {split: inside for split, inside in files.items() if inside}

    def runs(self, file: Path) -> Sequence[Run]:
        column = table_columns(file).run
        count = 1 if column is None else sum(1 for _ in _run_names(file, column))
        return [Run(file, index) for index in range(count)]

    def frames(self, run: Run) -> int:
        columns = table_columns(run.file)
        wanted = (columns.key, *((columns.run,) if columns.run else ()))
        for index, chunks in enumerate(_split_runs(read_chunks(run.file, wanted), columns.run)):
            if index == run.index:
                values = _join(chunks)[columns.key]
                return frame_numbers(values[~np.isnan(values)])[1] if values.dtype.kind == "f" else 0
        raise DataError(f"{run.file}: it has no run {run.index}.")

    def facts(self, file: Path) -> tuple[Metadata, frozenset[str], tuple[str, ...]]:
        columns = table_columns(file)
        dim, z = len(columns.position), columns.position[2:]
        flat = dim == 3 and all((chunk[z[0]] == 0).all() for chunk in read_chunks(file, z))
        names = _type_names(file, columns.types)
        metadata = placeholder_metadata(dim - flat, particle_types=dict(enumerate(names)))
        shown = f"{columns.key}, {columns.track}, {', '.join(columns.position)}"
        others = [name for name in columns.names if name not in columns.used]
        fields = f"; as fields, where they are numbers: {', '.join(others)}" if others else ""
        flat_note = ("z is 0 everywhere: the data are 2-D.",) if flat else ()
        unknown = EVERYTHING_UNKNOWN - ({"particle_types"} if names else set())
        return metadata, unknown, (f"Columns: {shown}{fields}.", *flat_note)

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        columns = table_columns(file)
        ids = {name: i for i, name in metadata.particle_types.items()}
        row = 1
        for index, chunks in enumerate(_split_runs(read_chunks(file, columns.names), columns.run)):
            where = f"{file}, run {index}" if columns.run else str(file)
            if index in set(indices):
                yield track_rows(_join(chunks), columns, metadata.dim, ids, where, row).trajectory(where)
            if index == max(indices):
                return
            row += sum(len(chunk[columns.key]) for chunk in chunks)


def _may_be_table(file: Path) -> bool:
    return ".txt" not in file.suffixes or bool(read_columns(file))


def table_columns(file: Path) -> Columns:
    """The columns of a table of tracks; a DataError that names the file and what is missing if it is none."""
    names = read_columns(file)
    try:
        return Columns(names)
    except DataError as error:
        raise DataError(f"{file}: it is no table of tracks: {error}") from error


def track_rows(
    table: Chunk, columns: Columns, dim: int, ids: Mapping[str, int], where: str, first_row: int
) -> TrackRows:
    """The rows of a run; those without an id or position are left out, the first with a warning."""
    key, time = table[columns.key], None if columns.time is None else table[columns.time]
    position = np.stack([table[name] for name in columns.position], axis=-1)
    for name, values in ((columns.key, key), (columns.time, time), (", ".join(columns.position), position)):
        if values is not None and values.dtype.kind != "f":
            raise DataError(f"{where}: the column {name} must contain numbers.")
    if len(columns.position) > dim and position[:, dim:].any():
        raise DataError(f"{where}: z is 0 in the first file, but not here.")
    track = table[columns.track]
    unlinked = np.isnan(track) if track.dtype.kind == "f" else track == ""
    keep = ~(unlinked | np.isnan(key) | np.isnan(position).any(axis=1))
    if unlinked.any():
        _log.warning("%s: %s without %s left out.", where, counted(int(unlinked.sum()), "row"), columns.track)
    if not keep.any():
        raise DataError(f"{where}: no row has an id, a frame and a position.")
    others = [name for name in columns.names if name not in columns.used and table[name].dtype.kind == "f"]
    velocity = np.stack([table[name] for name in columns.velocity[:dim]], axis=-1) if columns.velocity else None
    return TrackRows(
        first_row + np.flatnonzero(keep),
        position[keep, :dim],
        track[keep],
        key[keep],
        None if time is None else time[keep],
        None if columns.types is None else _type_ids(table[columns.types], ids, where)[keep],
        {name: table[name][keep] for name in others},
        None if velocity is None else velocity[keep],
    )


def _type_ids(types: np.ndarray, ids: Mapping[str, int], where: str) -> np.ndarray:
    if types.dtype.kind == "f":
        numbers: np.ndarray = np.nan_to_num(types).astype(np.int64)
        return numbers
    unknown = sorted(set(np.unique(types).tolist()) - set(ids))
    if unknown:
        raise DataError(
            f"{where}: the type {unknown[0]!r} does not occur in the first file; give it an id: --types"
            f" {len(ids)}={unknown[0]}."
        )
    return np.array([ids[name] for name in types.tolist()], np.int64)


def _run_names(file: Path, column: str) -> Iterator[Any]:
    """Yields the run of each group of rows; raises a DataError if rows of one are not together."""
    seen = set[Any]()
    for chunks in _split_runs(read_chunks(file, [column]), column):
        name = chunks[0][column][0]
        if name in seen:
            raise DataError(
                f"{file}: the rows of {column} {one_cell(name)} do not follow each other. Sort the table by {column}."
            )
        seen.add(name)
        yield name


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


def _join(chunks: Sequence[Chunk]) -> Chunk:
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def _type_names(file: Path, column: str | None) -> list[str]:
    """The types of a table that names them, in order of name."""
    names = set[str]()
    for chunk in read_chunks(file, [column]) if column else ():
        names.update(np.unique(chunk[column]).tolist() if column and chunk[column].dtype.kind == "U" else ())
    return sorted(names)
