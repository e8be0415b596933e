"""Builds a trajectory from its frames, one after the other, whatever the names and the order of the arrays in them."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np

from nmpm._support.memory import check_fits
from nmpm._support.messages import one_line
from nmpm.data.convert.frame import Frame, Layout, ParticleArrays
from nmpm.data.convert.named_arrays import AXES, plain_name, type_ids
from nmpm.data.format import ID, Trajectory
from nmpm.errors import DataError

_log = logging.getLogger(__name__)

_ABSENT_TYPE = -1
_FRAMES = 64
_PROPERTIES = ("radius", "diameter", "mass", "volume")


class FrameStack:
    """Collects the frames of one run in order, in arrays (T, N, …) that hold nothing twice.

    Particles are matched by their ids, where the frames have ids: those that a frame lacks are absent in it (NaN).

    Args:
        layout: Of the frames.
        type_ids: By name.
        frames: Number of frames, None where it is unknown.
    """

    def __init__(self, layout: Layout, type_ids: Mapping[str, int], frames: int | None = None) -> None:
        self._axes, self._constant, self._type_ids = list(layout.axes), layout.constant, type_ids
        self._id_name = layout.id_name
        self._frames, self._count = frames or _FRAMES, 0
        self._values: dict[str, np.ndarray] = {}  # (frames, particles, …), with room for more
        self._particles = self._room = 0
        self._types = np.zeros(0, np.int64)
        self._has_ids = self._has_types = False
        self._ids = np.zeros(0, np.int64)  # of the slots
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # ids of the last frame, and their slots
        self._times: list[float] = []
        self._start: np.datetime64 | None = None  # where times are dates
        self._steps: list[float] = []
        self._first = ""  # the first frame with particles
        self._empty = ""
        self._left_out: set[str] = set()

    def add(self, frame: Frame | None, where: str) -> None:
        """Adds a frame, at an unknown time and without particles where it is None; errors name it by `where`.

        Raises:
            DataError: if its particles cannot be matched with those of the frames before.
        """
        if frame is not None and len(frame.position):
            self._add_particles(frame, where)
        else:
            self._empty = self._empty or where
            self._reserve(self._count + 1, self._particles)
        time = None if frame is None else frame.time
        if isinstance(time, np.datetime64):
            self._start = time if self._start is None else self._start
            time = float((time - self._start) / np.timedelta64(1, "s"))
        self._times.append(np.nan if time is None else time)
        self._steps.append(np.nan if frame is None or frame.step is None else frame.step)
        self._count += 1

    def _add_particles(self, frame: Frame, where: str) -> None:
        arrays = ParticleArrays.of(frame, self._axes, self._id_name)
        has_types = arrays.type is not None or arrays.type_names is not None
        values = {"position": self._position(frame.position, where), **arrays.scalars}
        first = not self._first
        if first:
            self._first, self._has_ids, self._has_types = where, arrays.id is not None, has_types
        for what, has, before in (("ids", arrays.id is not None, self._has_ids), ("types", has_types, self._has_types)):
            if has != before:
                raise DataError(f"{where}: only some frames have {what} of particles ({self._first} differs).")
        slots = self._slots(arrays.id, len(frame.position), where)
        self._reserve(self._count + 1, self._particles)
        types = arrays.type
        if types is None and arrays.type_names is not None:
            types = type_ids(arrays.type_names, self._type_ids, where)
        if types is not None:
            self._merge_types(types, slots, where)
            values["position"][types == _ABSENT_TYPE] = np.nan
        if arrays.present is not None:
            values["position"][~arrays.present] = np.nan
        if arrays.velocity is not None:
            values["velocity"] = arrays.velocity
        if first:
            self._values = {name: self._empty_array(array) for name, array in values.items()}
        for name in sorted((set(self._values) ^ set(values)) - self._left_out):
            _log.warning("%s: the array %r is not in all frames; it is left out.", where, one_line(name, 60))
            self._left_out.add(name)
            self._values.pop(name, None)
        for name, array in self._values.items():
            if values[name].shape[1:] != array.shape[2:]:
                shapes = f"{values[name].shape[1:]} per particle, but {array.shape[2:]} in {self._first}"
                raise DataError(f"{where}: {one_line(name, 60)!r} has the shape {shapes}.")
            array[self._count, slots] = values[name]

    def _empty_array(self, values: np.ndarray) -> np.ndarray:
        """An array of all frames for values as those of one."""
        exact = values.dtype.kind in "iu" and values.dtype.itemsize > 2
        shape = (self._frames, self._room, *values.shape[1:])
        return np.full(shape, np.nan, np.float64 if exact else np.float32)

    def _position(self, values: np.ndarray, where: str) -> np.ndarray:
        """(N, D) float32 of the axes that are kept."""
        if values.shape[1] != len(self._axes) + len(self._constant):
            raise DataError(f"{where}: {values.shape[1]} axes, unlike the first frame.")
        for axis, value in self._constant.items():
            column = values[:, AXES.index(axis)]
            other = column[(column != value) & ~np.isnan(column)]
            if len(other):
                raise DataError(
                    f"{where}: {axis} = {other[0]:g}, but {value:g} for all particles of the first frames: the"
                    " data were taken as two-dimensional. Begin the run with a frame that is not flat."
                )
        with np.errstate(over="ignore"):
            position = values[:, self._axes].astype(np.float32)
        wrong = ~np.isfinite(position).all(axis=1) & ~np.isnan(position).all(axis=1)
        if wrong.any():
            particle = int(np.flatnonzero(wrong)[0])
            raise DataError(
                f"{where}: position of particle {particle} is {values[particle].tolist()}; it must be finite, or NaN"
                " in all coordinates where the particle is not there."
            )
        return position

    def _slots(self, ids: np.ndarray | None, count: int, where: str) -> np.ndarray | slice:
        """Indices of a frame's particles in the trajectory; makes room for those that are new."""
        if ids is None:
            if self._empty or self._particles not in (0, count):
                other = f"{self._particles} in {self._first}" if self._particles else f"none in {self._empty}"
                raise DataError(
                    f"{where}: {count} particles, but {other}. Where particles come and go,"
                    " give the particles an id array."
                )
            self._reserve(self._count, count)
            return slice(None, count)
        if self._last is not None and np.array_equal(ids, self._last[0]):
            return self._last[1]
        unique = np.unique(ids)
        if len(unique) < len(ids):
            values, counts = np.unique(ids, return_counts=True)
            raise DataError(f"{where}: {counts.max()} particles have the id {values[counts.argmax()]}.")
        new = np.setdiff1d(unique, self._ids, assume_unique=True)
        self._reserve(self._count, self._particles + len(new))
        self._ids = np.concatenate([self._ids, new])
        order = np.argsort(self._ids)
        slots = order[np.searchsorted(self._ids, ids, sorter=order)]
        self._last = ids, slots
        return slots

    def _reserve(self, frames: int, particles: int) -> None:
        """Makes room for so many frames and particles, at least for half as many more where the room is too small."""
        if frames > self._frames or particles > self._room:
            self._frames = self._frames if frames <= self._frames else 2 * self._frames
            if particles > self._room:
                self._room = particles + (particles // 2 if self._room else 0)
            check_fits(self._frames, self._room, len(self._axes), self._first)
            for name, old in self._values.items():
                self._values[name] = np.full((self._frames, self._room, *old.shape[2:]), np.nan, old.dtype)
                self._values[name][: self._count, : old.shape[1]] = old[: self._count]
        if particles > self._particles:
            self._types = np.concatenate([self._types, np.full(particles - self._particles, _ABSENT_TYPE)])
            self._particles = particles

    def _merge_types(self, types: np.ndarray, slots: np.ndarray | slice, where: str) -> None:
        """Notes the types of particles that are there for the first time, and checks the others."""
        before = self._types[slots]
        changed = (types != before) & (types != _ABSENT_TYPE)
        if not changed.any():
            return
        wrong = np.flatnonzero(changed & (before != _ABSENT_TYPE))
        if len(wrong):
            slot = int(np.arange(self._particles)[slots][wrong[0]])
            particle = f"with id {self._ids[slot]}" if self._has_ids else str(slot)
            raise DataError(
                f"{where}: particle {particle} has type {types[wrong[0]]}, but {before[wrong[0]]} in frames before."
                " Types must not change; store what changes under another name, as a field."
            )
        self._types[slots] = np.where(changed, types, before)

    def trajectory(self, where: str) -> Trajectory:
        """The frames as a trajectory, particles ordered by their ids.

        Raises:
            DataError: if there are no particles; names the run by `where`.
        """
        values = {name: array[: self._count, : self._particles] for name, array in self._values.items()}
        types = self._types if self._has_types else np.zeros(self._particles, np.int64)
        order = np.argsort(self._ids) if self._has_ids else np.arange(self._particles)
        never = int((types == _ABSENT_TYPE).sum())
        if never:
            _log.warning("%s: %d particles have type %d in all frames and are left out.", where, never, _ABSENT_TYPE)
            order = order[types[order] != _ABSENT_TYPE]
        if not len(order):
            raise DataError(f"{where}: there are no particles.")
        if not np.array_equal(order, np.arange(self._particles)):
            for array in values.values():
                for row in array:  # in place: no second copy of the run
                    row[: len(order)] = row[order]
        values = {name: _constant(name, array[:, : len(order)]) for name, array in values.items()}
        position, ids = values.pop("position"), {ID: self._ids[order]} if self._has_ids else {}
        return Trajectory(position, types[order], {}, values | ids | self._time())

    def _time(self) -> dict[str, np.ndarray]:
        """The field `time` (T,), or steps' numbers, where two or more frames state it; the others are interpolated."""
        for values in map(np.array, (self._times, self._steps)):
            stated = np.flatnonzero(~np.isnan(values))
            if len(stated) >= max(2, len(values) // 2) and np.ptp(values[stated]) > 0:
                return {"time": np.interp(np.arange(len(values)), stated, values[stated])}
        return {}


def _constant(name: str, values: np.ndarray) -> np.ndarray:
    """(N,) sizes and masses of particles where (T, N) ones do not change in time."""
    if plain_name(name) not in _PROPERTIES:
        return values
    last = np.fmax.reduce(values)
    return last if ((values == last) | np.isnan(values)).all() else values
