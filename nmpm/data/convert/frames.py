"""Frames as files have them, their arrays sorted by usual names, and the trajectory that they make up."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nmpm._support.machine import check_fits
from nmpm._support.messages import one_line
from nmpm.data.convert.named_arrays import (
    AXES,
    COMPONENTS,
    USUAL_NAMES,
    by_plain_name,
    component_names,
    constant_axis,
    plain_name,
    type_ids,
    with_meaning,
)
from nmpm.data.format import ID, Trajectory
from nmpm.errors import DataError
from nmpm.scene import Boundary, Interval

ARRAY_NAMES = frozenset(
    {
        *(name for spelling in COMPONENTS["velocity"] for name in spelling),
        *(name for meaning in ("id", "types", "active", "velocity") for name in USUAL_NAMES[meaning]),
    }
)
"""Names of arrays with a meaning, in lower case without separators."""
ID_STRIDE = 2**32
"""Between the ids of the parts of a frame."""


@dataclass(frozen=True)
class Frame:
    """One frame as its file has it; None is what the file does not state."""

    position: np.ndarray  # (N, D), NaN in all coordinates of particles that are not there
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)  # (N,) or (N, k) by the names in the file
    time: float | np.datetime64 | None = None  # in the file's unit
    step: int | None = None  # number of the simulator's step
    box: tuple[Interval, ...] | None = None  # (lower, upper) per axis, of the simulator
    boundary: tuple[Boundary, ...] | None = None  # of the box, per axis
    left_out: tuple[str, ...] = ()  # names of what else is in the file
    surface: bool = False  # whether its points are corners of lines or faces


def join_frames(parts: Sequence[tuple[str, Frame]]) -> Frame:
    """The particles of several frames, with their materials' names as types; arrays that not all have are left out.

    Ids of the first part stay; those of the others, which may be the same numbers, are counted from `ID_STRIDE` on.
    """
    first, counts = parts[0][1], [len(frame.position) for _, frame in parts]

    def fits(name: str, values: np.ndarray | None) -> bool:
        like = first.arrays[name]
        texts = like.dtype.kind == "U"
        return values is not None and values.shape[1:] == like.shape[1:] and (values.dtype.kind == "U") == texts

    names = [name for name in first.arrays if all(fits(name, frame.arrays.get(name)) for _, frame in parts)]
    types = with_meaning("types", names)
    arrays = {
        f"{name}_in_file" if name in types else name: np.concatenate([frame.arrays[name] for _, frame in parts])
        for name in names
    }
    for name in with_meaning("id", arrays):
        if arrays[name].dtype.kind in "iuf":
            arrays[name] = arrays[name].astype(np.int64) + np.repeat(np.arange(len(parts)) * ID_STRIDE, counts)
    left_out = [name for _, frame in parts for name in frame.left_out]
    left_out += [name for _, frame in parts for name in frame.arrays if name not in names]
    return replace(
        first,
        position=np.concatenate([frame.position for _, frame in parts]),
        arrays=arrays | {"material": np.repeat([name for name, _ in parts], counts)},
        left_out=tuple(dict.fromkeys(left_out)),
    )


def flat_axes(frames: Sequence[Frame]) -> dict[str, float]:
    """The `constant_axis` of the frames of three axes."""
    positions = [frame.position for frame in frames if frame.position.shape[1] == len(AXES)]
    return constant_axis(np.concatenate(positions)) if positions else {}


@dataclass(frozen=True)
class FrameLayout:
    """What the first frames tell about all."""

    axes: tuple[int, ...]  # those of the files that are kept
    constant: Mapping[str, float]  # values of the axes that are left out, the same for all particles
    id_name: str | None  # the array of the particles' ids
    left_out: tuple[str, ...]  # names of what else is in the files

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> FrameLayout:
        """The layout of frames: an axis in which nothing has an extent is left out; ids differ in the first frame."""
        constant, first = flat_axes(frames), frames[0]
        axes = tuple(axis for axis in range(first.position.shape[1]) if AXES[axis] not in constant)
        ids = {name: _integers(first.arrays[name]) for name in with_meaning("id", first.arrays)}
        unique = (name for name, values in ids.items() if values is not None and len(np.unique(values)) == len(values))
        id_name = next(unique, None)
        texts = FrameArrays.of(first, axes, id_name).texts
        return cls(axes, constant, id_name, (*first.left_out, *texts))


def wrap(position: np.ndarray, box: Sequence[Interval] | None, boundary: Sequence[Boundary] | None) -> np.ndarray:
    """(N, D) positions within the box along periodic axes."""
    for axis, kind in enumerate((boundary or ())[: position.shape[1]]):
        low, high = box[axis] if box else (0.0, 0.0)
        values = position[:, axis]
        outside = (values < low) | (values >= high)
        if kind == "periodic" and high > low and outside.any():
            position[:, axis] = np.where(outside, low + (values - low) % (high - low), values)
    return position


@dataclass(frozen=True)
class FrameArrays:
    """The arrays of a frame by what they are."""

    id: np.ndarray | None  # (N,) int64
    type: np.ndarray | None  # (N,) int64
    type_names: np.ndarray | None  # (N,) str
    present: np.ndarray | None  # (N,) bool
    velocity: np.ndarray | None  # (N, D) of the axes that are kept
    scalars: Mapping[str, np.ndarray]  # (N,) each
    texts: tuple[str, ...]  # names of other arrays that have no numbers

    @classmethod
    def of(cls, frame: Frame, axes: Sequence[int], id_name: str | None) -> FrameArrays:
        """Sorts arrays by their usual names; what has another name, or does not fit its name, is a field.

        Args:
            frame: The frame.
            axes: The axes of the positions that are kept; a velocity has them, too.
            id_name: The array of ids; None if there is none.
        """
        left: dict[str, np.ndarray] = {}
        for name, values in frame.arrays.items():
            values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
            if plain_name(name) not in (AXES if values.ndim == 1 else USUAL_NAMES["position"]):
                left[name] = values
        identity = _integers(left.pop(id_name)) if id_name in left else None

        def take(meaning: str, convert: Callable[[np.ndarray], np.ndarray | None]) -> np.ndarray | None:
            """Removes the first array whose name has a meaning and that fits, and returns it, or else None."""
            for name in with_meaning(meaning, left):
                if (values := convert(left[name])) is not None:
                    del left[name]
                    return values
            return None

        def vectors(values: np.ndarray) -> np.ndarray | None:
            fits = values.ndim == 2 and max(axes) < values.shape[1] <= len(AXES) and values.dtype.kind in "iuf"
            return values[:, axes] if fits else None

        def strings(values: np.ndarray) -> np.ndarray | None:
            return values.astype(str) if values.ndim == 1 and values.dtype.kind in "SU" else None

        present, types, type_names = take("active", _logicals), take("types", _integers), take("types", strings)
        if (velocity := take("velocity", vectors)) is None:  # or an array per axis
            flat = [name for name, values in left.items() if values.ndim == 1 and values.dtype.kind in "iuf"]
            names = component_names(by_plain_name(flat), "velocity")
            if len(names) > max(axes):
                columns = [left.pop(name) for name in names]
                velocity = np.stack([columns[axis] for axis in axes], axis=1)
        scalars = dict[str, np.ndarray]()
        for key, values in left.items():
            name = "particle_time" if key == "time" else key.replace("/", "_")
            if values.dtype.kind in "biuf" and values.ndim == 1:
                scalars[name] = values
            elif values.dtype.kind in "biuf":
                ends = AXES if values.shape[1] <= len(AXES) else range(values.shape[1])
                scalars |= {f"{name}_{end}": column for end, column in zip(ends, values.T, strict=False)}
        texts = tuple(name for name, values in left.items() if values.dtype.kind not in "biuf")
        return cls(identity, types, type_names, None if present is None else present != 0, velocity, scalars, texts)


def _integers(values: np.ndarray) -> np.ndarray | None:
    if values.ndim != 1 or values.dtype.kind not in "biuf":
        return None
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.rint(values)).all()):
        return None
    return values.astype(np.int64)


def _logicals(values: np.ndarray) -> np.ndarray | None:
    texts = values.dtype.kind in "SU" and np.isin(values.astype(str), ("T", "F", "True", "False")).all()
    return _integers(np.char.startswith(values.astype(str), "T")) if texts else _integers(values)


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

    def __init__(self, layout: FrameLayout, type_ids: Mapping[str, int], frames: int | None = None) -> None:
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
        arrays = FrameArrays.of(frame, self._axes, self._id_name)
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
            for name, array in values.items():
                exact = array.dtype.kind in "iu" and array.dtype.itemsize > 2
                shape = (self._frames, self._room, *array.shape[1:])
                self._values[name] = np.full(shape, np.nan, np.float64 if exact else np.float32)
        for name in sorted((set(self._values) ^ set(values)) - self._left_out):
            _log.warning("%s: the array %r is not in all frames; it is left out.", where, one_line(name, 60))
            self._left_out.add(name)
            self._values.pop(name, None)
        for name, array in self._values.items():
            if values[name].shape[1:] != array.shape[2:]:
                shapes = f"{values[name].shape[1:]} per particle, but {array.shape[2:]} in {self._first}"
                raise DataError(f"{where}: {one_line(name, 60)!r} has the shape {shapes}.")
            array[self._count, slots] = values[name]

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

        Sizes and masses of particles that do not change in time are (N,). The field `time` (T,) are times, or else
        steps' numbers, where two or more frames state them; the others are interpolated.

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
        for name, array in values.items():
            values[name] = array[:, : len(order)]
            if plain_name(name) in _PROPERTIES:
                last = np.fmax.reduce(values[name])
                if ((values[name] == last) | np.isnan(values[name])).all():
                    values[name] = last
        position, fields = values.pop("position"), values | ({ID: self._ids[order]} if self._has_ids else {})
        for times in map(np.array, (self._times, self._steps)):
            stated = np.flatnonzero(~np.isnan(times))
            if len(stated) >= max(2, len(times) // 2) and np.ptp(times[stated]) > 0:
                fields["time"] = np.interp(np.arange(len(times)), stated, times[stated])
                break
        return Trajectory(position, types[order], {}, fields)
