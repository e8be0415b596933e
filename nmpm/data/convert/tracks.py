"""Tables of tracks: a row for each particle in each frame, with a frame or time, an id and coordinates.

As particle tracking writes them. Names of columns may end in units; a column `run` tells runs apart, whose rows follow
each other. Other columns of numbers become fields. Times on a regular grid of which some are missing have frames in
which nobody is there.
"""

from __future__ import annotations

import heapq
import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nmpm._support.messages import counted
from nmpm.data.convert.base import EVERYTHING_UNKNOWN, Facts, Options, Run, RunFiles, located, placeholder_metadata
from nmpm.data.convert.named_arrays import (
    AXES,
    CONSTANT,
    as_times,
    component_names,
    constant_axis,
    drop_axis,
    in_plane,
    plane_notes,
    type_ids,
)
from nmpm.data.convert.tables import (
    SUFFIXES,
    USUAL_COLUMNS,
    Chunk,
    join_chunks,
    number_columns,
    one_cell,
    plain_column,
    read_chunks,
    read_columns,
)
from nmpm.data.format import ID, TRACK, Metadata, Trajectory
from nmpm.errors import DataError, NmpmError

_log = logging.getLogger(__name__)


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

    def facts(self, file: Path, options: Options) -> Facts:  # noqa: ARG002
        columns = table_columns(file)
        coordinates = columns.position if len(columns.position) == len(AXES) else ()
        wanted = [*coordinates, *([columns.types] if columns.types else [])]
        ends, names = [np.zeros((0, len(coordinates)))], set[str]()
        for chunk in read_chunks(file, wanted) if wanted else ():
            if coordinates and all(chunk[name].dtype.kind == "f" for name in coordinates):
                position = np.stack([chunk[name] for name in coordinates], axis=-1)
                ends += [np.fmin.reduce(position)[None], np.fmax.reduce(position)[None]]
            if columns.types and chunk[columns.types].dtype.kind == "U":
                names.update(np.unique(chunk[columns.types]).tolist())
        constant = constant_axis(np.concatenate(ends))
        shown = f"{columns.key}, {columns.track}, {', '.join(columns.position)}"
        fields = f"; as fields, where they are numbers: {', '.join(columns.others)}" if columns.others else ""
        extra = {CONSTANT: constant} if constant else {}
        dim = len(columns.position) - len(constant)
        metadata = placeholder_metadata(dim, particle_types=dict(enumerate(sorted(names))), extra=extra)
        unknown = EVERYTHING_UNKNOWN - ({"particle_types"} if names else set())
        return Facts(metadata, unknown, (f"Columns: {shown}{fields}.", *plane_notes(constant)))

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
    constant, track = metadata.extra.get(CONSTANT, {}), table[columns.track]
    with located(where):
        position = number_columns(table, columns.position)
        active = np.ones(len(key)) if columns.active is None else number_columns(table, [columns.active])[:, 0]
    position = in_plane(position, metadata.dim, constant, where)
    if not np.isin(active, (0, 1)).all():
        raise DataError(f"{where}: {columns.active} must be 0 where a particle is absent, and 1 elsewhere.")
    unlinked = np.isnan(track) if track.dtype.kind == "f" else track == ""
    keep = ~(unlinked | np.isnan(key) | np.isnan(position).any(axis=1)) & (active == 1)
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


_JITTER = 0.1  # of the time between frames
_GAPS = 4  # frames of a regular grid per frame that is there
_SPARSE = 4  # entries of (T, ids) arrays per row, beyond which tracks share slots


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
        self._check_rows(track, frame_of, where)
        types = self._types_of_tracks(track, where)
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
        fields = {name: _filled(placed(values), present) for name, values in self.values.items()}
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

    def _check_rows(self, track: np.ndarray, frame_of: np.ndarray, where: str) -> None:
        order = np.lexsort((frame_of, track))
        same = (np.diff(track[order]) == 0) & (np.diff(frame_of[order]) == 0)
        if same.any():
            first = int(np.argmax(same))
            one, other = sorted(order[first : first + 2].tolist())
            name = one_cell(self.track[one])
            raise DataError(
                f"{where}: rows {self.row[one]} and {self.row[other]} are both track {name} in frame {frame_of[one]}"
                f" (at {self.key[one]:g}). Remove one, or state the run of each in a column run."
            )

    def _types_of_tracks(self, track: np.ndarray, where: str) -> np.ndarray:
        """(tracks,) type ids."""
        types = np.zeros(int(track.max()) + 1, np.int64)
        types[track] = self.types
        changes = types[track] != self.types
        if changes.any():
            index = int(np.argmax(changes))
            raise DataError(f"{where}: track {one_cell(self.track[index])} changes its type in row {self.row[index]}.")
        return types


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


def _filled(field: np.ndarray, present: np.ndarray) -> np.ndarray:
    """(T, N) values, or (N,) constant ones, of which absent particles have the one before or else after."""
    last = np.maximum.accumulate(np.where(present, np.arange(len(present))[:, None], -1), axis=0)
    field = np.take_along_axis(field, np.where(last < 0, present.argmax(axis=0), last), axis=0)
    return field[0] if (field == field[0]).all() else field
