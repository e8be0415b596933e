"""Tables of tracks: a row for each particle in each frame, with a frame or time, an id and coordinates.

As particle tracking writes them. Names of columns may end in units; a column `run` tells runs apart, whose rows follow
each other. Other columns of numbers become fields. Times on a regular grid of which some are missing have frames in
which nobody is there.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.convert.named_arrays import (
    AXES,
    CONSTANT,
    USUAL_NAMES,
    as_times,
    component_names,
    constant_axis,
    drop_axis,
    in_plane,
    plane_notes,
    type_ids,
)
from nmpm.data.convert.run_files import EVERYTHING_UNKNOWN, Facts, Run, RunFiles, placeholder_metadata
from nmpm.data.convert.tables import (
    SUFFIXES,
    Chunk,
    as_numbers,
    join_chunks,
    one_cell,
    plain_column,
    read_chunks,
    read_columns,
)
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
    "active": USUAL_NAMES["active"],
}  # fmt: skip
"""Names of columns by what they mean, in lower case without separators and units."""


@dataclass(frozen=True)
class Columns:
    """Names of a table's columns by what they mean; None or () where there are none."""

    names: Sequence[str]  # all
    frame: str | None
    time: str | None
    track: str
    run: str | None
    types: str | None
    active: str | None
    position: tuple[str, ...]
    velocity: tuple[str, ...]

    @property
    def key(self) -> str:
        """The column by which rows are in the same frame."""
        return self.frame or self.time or ""

    @property
    def others(self) -> list[str]:
        """Columns without a meaning."""
        used = {self.frame, self.time, self.track, self.run, self.types, self.active, *self.position, *self.velocity}
        return [name for name in self.names if name not in used]


def table_columns(file: Path) -> Columns:
    """The columns of a table of tracks; a DataError that names the file and what is missing if it is none."""
    names = read_columns(file)
    plain = {plain_column(name): name for name in reversed(names)}
    parts = {key: next((plain[name] for name in usual if name in plain), None) for key, usual in USUAL_COLUMNS.items()}
    position, velocity = component_names(plain, "position"), component_names(plain, "velocity")
    if parts["track"] is None:  # tracks are called trajectories too
        parts |= {"track": parts["run"], "run": None}
    key, track = parts["frame"] or parts["time"], parts.pop("track")
    needed = {"id": track, "coordinates x, y": position, "frame or time": key}
    missing = [what for what, column in needed.items() if not column]
    if track is None or missing:
        columns = f"no column {' and no column '.join(missing)} (columns: {', '.join(names[:12])})"
        problem = columns if names else "it has no header with names of columns"
        raise DataError(f"{file}: it is no table of tracks: {problem}.")
    velocity = velocity if len(velocity) == len(position) else ()
    return Columns(names, track=track, position=position, velocity=velocity, **parts)


def coordinate_columns(names: Sequence[str]) -> tuple[str, ...]:
    """The columns of the coordinates x, y and z, as far as there are."""
    return component_names({plain_column(name): name for name in reversed(names)}, "position")


class Tracks(RunFiles):
    """Tables of tracks; particles that are in no row of a frame are absent in it."""

    name: ClassVar[str] = "tracks"
    summary: ClassVar[str] = "tables of tracks (.csv, .tsv, .txt, .gz, .parquet): frame or time, id, x, y, z"
    patterns: tuple[str, ...] = SUFFIXES

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
        if column is None:
            return [Run(file, 0)]
        names = [chunks[0][column][0] for chunks in _split_runs(read_chunks(file, [column]), column)]
        for name, count in Counter(names).items():
            if count > 1:
                rows = f"the rows of {column} {one_cell(name)}"
                raise DataError(f"{file}: {rows} do not follow each other. Sort the table by {column}.")
        return [Run(file, index) for index in range(len(names))]

    def frames(self, run: Run) -> int:
        columns = table_columns(run.file)
        wanted = (columns.key, *((columns.run,) if columns.run else ()))
        for index, chunks in enumerate(_split_runs(read_chunks(run.file, wanted), columns.run)):
            if index == run.index:
                values = join_chunks(chunks)[columns.key]
                times = as_times(values, f"{run.file}: the column {columns.key}")
                return frame_numbers(times[~np.isnan(times)])[1]
        raise DataError(f"{run.file}: it has no run {run.index}.")

    def facts(self, file: Path) -> Facts:
        columns = table_columns(file)
        constant = _constant_axis(file, columns.position)
        names = _type_names(file, columns.types) if columns.types else []
        shown = f"{columns.key}, {columns.track}, {', '.join(columns.position)}"
        fields = f"; as fields, where they are numbers: {', '.join(columns.others)}" if columns.others else ""
        extra = {CONSTANT: constant} if constant else {}
        dim = len(columns.position) - len(constant)
        metadata = placeholder_metadata(dim, particle_types=dict(enumerate(names)), extra=extra)
        unknown = EVERYTHING_UNKNOWN - ({"particle_types"} if names else set())
        return metadata, unknown, (f"Columns: {shown}{fields}.", *plane_notes(constant))

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        columns = table_columns(file)
        row = 1
        for index, chunks in enumerate(_split_runs(read_chunks(file, columns.names), columns.run)):
            where = f"{file}, run {index}" if columns.run else str(file)
            if index in set(indices):
                yield track_rows(join_chunks(chunks), columns, metadata, where, row).trajectory(where)
            if index == max(indices):
                return
            row += sum(len(chunk[columns.key]) for chunk in chunks)


def _may_be_table(file: Path) -> bool:
    try:
        return ".txt" not in file.suffixes or bool(read_columns(file))
    except DataError:
        return False


def track_rows(table: Chunk, columns: Columns, metadata: Metadata, where: str, first_row: int) -> TrackRows:
    """The rows of a run; those without an id or position are left out, the first with a warning."""
    key = as_times(table[columns.key], f"{where}: the column {columns.key}")
    time = None if columns.time is None else as_times(table[columns.time], f"{where}: the column {columns.time}")
    position = np.stack([as_numbers(table[name], f"{where}: the column {name}") for name in columns.position], axis=-1)
    constant = metadata.extra.get(CONSTANT, {})
    position = in_plane(position, metadata.dim, constant, where)
    track = table[columns.track]
    unlinked = np.isnan(track) if track.dtype.kind == "f" else track == ""
    keep = ~(unlinked | np.isnan(key) | np.isnan(position).any(axis=1)) & _active(table, columns, where)
    if unlinked.any():
        _log.warning("%s: %s without %s left out.", where, counted(int(unlinked.sum()), "row"), columns.track)
    if not keep.any():
        raise DataError(f"{where}: no row has an id, a frame and a position.")
    types = table[columns.types] if columns.types else np.zeros(len(track))
    if types.dtype.kind == "f":
        types = np.nan_to_num(types).astype(np.int64)
    else:
        types = type_ids(types, {name: i for i, name in metadata.particle_types.items()}, where)
    velocity = drop_axis(np.array(columns.velocity), constant).tolist() if columns.velocity else []
    return TrackRows(
        first_row + np.flatnonzero(keep),
        position[keep],
        track[keep],
        key[keep],
        None if time is None else time[keep],
        types[keep],
        {name: table[name][keep] for name in columns.others if table[name].dtype.kind == "f"},
        np.stack([table[name][keep] for name in velocity], axis=-1) if velocity else None,
    )


def _active(table: Chunk, columns: Columns, where: str) -> np.ndarray:
    """(n,) bool, which rows are of particles that are there."""
    if columns.active is None:
        return np.ones(len(table[columns.key]), bool)
    active = as_numbers(table[columns.active], f"{where}: the column {columns.active}")
    if not np.isin(active, (0, 1)).all():
        raise DataError(f"{where}: {columns.active} must be 0 where a particle is absent, and 1 elsewhere.")
    return np.asarray(active == 1)


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


def _constant_axis(file: Path, names: Sequence[str]) -> dict[str, float]:
    """The constant axis of a table's coordinates, of which the extremes of all chunks tell."""
    ends = [np.zeros((0, len(names)))]
    for chunk in read_chunks(file, names) if len(names) == len(AXES) else ():
        if all(chunk[name].dtype.kind == "f" for name in names):
            position = np.stack([chunk[name] for name in names], axis=-1)
            ends += [np.fmin.reduce(position)[None], np.fmax.reduce(position)[None]]
    return constant_axis(np.concatenate(ends))


def _type_names(file: Path, column: str) -> list[str]:
    """The types of a table that names them, in order of name."""
    names = set[str]()
    for chunk in read_chunks(file, [column]):
        names.update(np.unique(chunk[column]).tolist() if chunk[column].dtype.kind == "U" else ())
    return sorted(names)
