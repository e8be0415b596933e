"""Rows of a table of tracks as a trajectory: frames from times, slots for particles that come and go."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nmpm.data.convert.tables import one_cell
from nmpm.data.format import ID, TRACK, Trajectory
from nmpm.errors import DataError

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
