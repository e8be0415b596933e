"""A frame as its file has it, and its arrays sorted by their usual names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from nmpm.data.convert.named_arrays import (
    AXES,
    COMPONENTS,
    USUAL_NAMES,
    by_plain_name,
    component_names,
    constant_axis,
    plain_name,
    plane_notes,
    with_meaning,
)
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
    first = parts[0][1]
    names = [
        name for name in first.arrays if all(_fits(first.arrays[name], frame.arrays.get(name)) for _, frame in parts)
    ]
    types = with_meaning("types", names)
    arrays = {
        f"{name}_in_file" if name in types else name: np.concatenate([frame.arrays[name] for _, frame in parts])
        for name in names
    }
    for name in with_meaning("id", arrays):
        if arrays[name].dtype.kind in "iuf":
            starts = np.repeat(np.arange(len(parts)) * ID_STRIDE, [len(frame.position) for _, frame in parts])
            arrays[name] = arrays[name].astype(np.int64) + starts
    return replace(
        first,
        position=np.concatenate([frame.position for _, frame in parts]),
        arrays=arrays
        | {"material": np.repeat([name for name, _ in parts], [len(frame.position) for _, frame in parts])},
        left_out=tuple(
            dict.fromkeys(
                [
                    *(name for _, frame in parts for name in frame.left_out),
                    *(name for _, frame in parts for name in frame.arrays if name not in names),
                ]
            )
        ),
    )


def _fits(values: np.ndarray, other: np.ndarray | None) -> bool:
    return (
        other is not None
        and other.shape[1:] == values.shape[1:]
        and (other.dtype.kind == "U") == (values.dtype.kind == "U")
    )


def flat_axes(frames: Sequence[Frame]) -> dict[str, float]:
    """The `constant_axis` of the frames of three axes."""
    positions = [frame.position for frame in frames if frame.position.shape[1] == len(AXES)]
    return constant_axis(np.concatenate(positions)) if positions else {}


@dataclass(frozen=True)
class Layout:
    """What the first frames tell about all."""

    axes: tuple[int, ...]  # those of the files that are kept
    constant: Mapping[str, float]  # values of the axes that are left out, the same for all particles
    id_name: str | None  # the array of the particles' ids
    left_out: tuple[str, ...]  # names of what else is in the files

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> Layout:
        """The layout of frames: an axis in which nothing has an extent is left out; ids differ in the first frame."""
        constant, first = flat_axes(frames), frames[0]
        axes = tuple(axis for axis in range(first.position.shape[1]) if AXES[axis] not in constant)
        ids = {name: _integers(first.arrays[name]) for name in with_meaning("id", first.arrays)}
        unique = (name for name, values in ids.items() if values is not None and len(np.unique(values)) == len(values))
        id_name = next(unique, None)
        texts = ParticleArrays.of(first, axes, id_name).texts
        return cls(axes, constant, id_name, (*first.left_out, *texts))

    def notes(self) -> tuple[str, ...]:
        """For the user."""
        notes = [*plane_notes(self.constant)]
        notes += [f"Particles are matched by the array {self.id_name!r}."] if self.id_name else []
        left_out = ", ".join(self.left_out)
        return (*notes, *([f"Left out, as they are not numbers of all particles: {left_out}."] if left_out else []))


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
class ParticleArrays:
    """The arrays of a frame by what they are."""

    id: np.ndarray | None  # (N,) int64
    type: np.ndarray | None  # (N,) int64
    type_names: np.ndarray | None  # (N,) str
    present: np.ndarray | None  # (N,) bool
    velocity: np.ndarray | None  # (N, D) of the axes that are kept
    scalars: Mapping[str, np.ndarray]  # (N,) each
    texts: tuple[str, ...]  # names of other arrays that have no numbers

    @classmethod
    def of(cls, frame: Frame, axes: Sequence[int], id_name: str | None) -> ParticleArrays:
        """Sorts arrays by their usual names; what has another name, or does not fit its name, is a field.

        Args:
            frame: The frame.
            axes: The axes of the positions that are kept; a velocity has them, too.
            id_name: The array of ids; None if there is none.
        """
        single = {n: v[:, 0] if v.ndim == 2 and v.shape[1] == 1 else v for n, v in frame.arrays.items()}
        left = {name: values for name, values in single.items() if not _is_position(name, values)}
        identity = _integers(left.pop(id_name)) if id_name in left else None
        present = _take(left, "active", _logicals)
        types, type_names = _take(left, "types", _integers), _take(left, "types", _strings)
        velocity = _take(left, "velocity", partial(_vectors, axes=axes))
        velocity = _take_components(left, axes) if velocity is None else velocity
        scalars = {name: scalar for key, values in left.items() for name, scalar in _scalars(key, values)}
        texts = tuple(name for name, values in left.items() if values.dtype.kind not in "biuf")
        return cls(identity, types, type_names, None if present is None else present != 0, velocity, scalars, texts)


def _is_position(name: str, values: np.ndarray) -> bool:
    return plain_name(name) in (AXES if values.ndim == 1 else USUAL_NAMES["position"])


def _take(
    arrays: dict[str, np.ndarray], meaning: str, convert: Callable[[np.ndarray], np.ndarray | None]
) -> np.ndarray | None:
    """Removes the first array whose name has a meaning and that fits, and returns it; None if there is none."""
    for name in with_meaning(meaning, arrays):
        values = convert(arrays[name])
        if values is not None:
            del arrays[name]
            return values
    return None


def _integers(values: np.ndarray) -> np.ndarray | None:
    if values.ndim != 1 or values.dtype.kind not in "biuf":
        return None
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.rint(values)).all()):
        return None
    return values.astype(np.int64)


def _logicals(values: np.ndarray) -> np.ndarray | None:
    texts = values.dtype.kind in "SU" and np.isin(values.astype(str), ("T", "F", "True", "False")).all()
    return _integers(np.char.startswith(values.astype(str), "T")) if texts else _integers(values)


def _strings(values: np.ndarray) -> np.ndarray | None:
    return values.astype(str) if values.ndim == 1 and values.dtype.kind in "SU" else None


def _vectors(values: np.ndarray, axes: Sequence[int]) -> np.ndarray | None:
    fits = values.ndim == 2 and max(axes) < values.shape[1] <= len(AXES) and values.dtype.kind in "iuf"
    return values[:, axes] if fits else None


def _take_components(arrays: dict[str, np.ndarray], axes: Sequence[int]) -> np.ndarray | None:
    """Removes a velocity that is stored as an array per axis, and returns it (N, D)."""
    plain = by_plain_name(name for name, values in arrays.items() if values.ndim == 1 and values.dtype.kind in "iuf")
    names = component_names(plain, "velocity")
    if len(names) <= max(axes):
        return None
    columns = [arrays.pop(name) for name in names]
    return np.stack([columns[axis] for axis in axes], axis=1)


def _scalars(name: str, values: np.ndarray) -> Iterable[tuple[str, np.ndarray]]:
    """Names and (N,) values of an array's components; nothing for strings."""
    if values.dtype.kind not in "biuf":
        return []
    name = "particle_time" if name == "time" else name.replace("/", "_")
    if values.ndim == 1:
        return [(name, values)]
    ends = AXES if values.shape[1] <= len(AXES) else range(values.shape[1])
    return [(f"{name}_{end}", column) for end, column in zip(ends, values.T, strict=False)]
