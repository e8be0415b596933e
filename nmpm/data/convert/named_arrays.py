"""Meanings of arrays by their usual names and shapes: positions, types, velocities, masks, times, facts.

Arrays are anything with `shape`, `dtype` and rows along the first axis, so that files are read run by run. T frames,
N particles, D = 1 to 3 axes; R runs may be stacked in front.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any, Protocol

import numpy as np

from nmpm._support.messages import one_line
from nmpm.errors import DataError

AXES = "xyz"
"""Names of the axes."""
CONSTANT = "constant_axis"
"""Key of the metadata: the axis that is left out, and the coordinate of all particles along it."""

USUAL_NAMES: Mapping[str, tuple[str, ...]] = {
    "position": (
        "position", "positions", "pos", "coordinates", "coordinate", "coords", "points", "particles",
        "particlepositions", "particleposition", "locations", "trajectory", "trajectories", "traj", "xyz", "xy",
        "x", "r",
    ),
    "types": (
        "particletype", "particletypes", "types", "type", "materials", "material", "materialids", "materialid",
        "matid", "phases", "phase", "species", "atomtypes", "labels", "label", "element", "elements", "kind",
        "mk",
    ),
    "velocity": ("velocity", "velocities", "particlevelocities", "vel", "vels", "v"),
    "active": (
        "active", "isactive", "alive", "isalive", "present", "ispresent", "exists", "exist", "visible", "mask", "valid",
        "isvalid", "validity", "activemask", "validmask", "particlemask",
    ),
    "id": (
        "id", "ids", "particle", "particleid", "particleids", "pid", "idp", "uid", "tag", "track", "trackid", "gid",
        "globalid", "globalids",
    ),
    "time": ("time", "times", "timestamps", "t", "tcurrent", "currenttime", "simulationtime", "timevalue"),
    "step": ("step", "timestepnumber", "iteration", "count"),
    "dt": ("dt", "deltat", "framedt", "timestep", "frameinterval"),
    "gravity": ("gravity", "grav", "g"),
    "bounds": ("bounds", "box", "boundingbox", "bbox", "domain", "limits"),
    "particle_volume": ("particlevolume",),
    "type_names": ("typenames", "particletypenames", "materialnames", "names"),
    "static_types": ("statictypes",),
    "boundary": ("boundary", "boundaries", "boundaryconditions"),
}  # fmt: skip
"""Names of arrays by what they mean, in lower case without separators; the first that fits is taken."""

COMPONENTS: Mapping[str, tuple[Sequence[str], ...]] = {
    "position": tuple(
        [prefix + axis for axis in axes]
        for prefix in ("", "pos", "position", "p", "coord", "coordinates", "points", "centroid")
        for axes in (AXES, "012")
    ),
    "velocity": (
        *([prefix + axis for axis in axes] for prefix in ("v", "vel", "velocity") for axes in (AXES, "012")),
        "uvw",
    ),
}
"""Names of arrays that hold one axis each."""


_SAMPLE = 64  # entries along each axis that are compared


class ArrayLike(Protocol):
    """An array that is read when it is indexed: NumPy's, or a dataset in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its size along each axis."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The kind of its numbers."""

    def __getitem__(self, rows: Any, /) -> Any:
        """A row of the first axis, or all for (), as a NumPy array."""


Arrays = Mapping[str, ArrayLike]


@dataclass(frozen=True)
class Components:
    """Coordinates that are stored in an array each, as one array with the axes of space last."""

    parts: Sequence[ArrayLike]

    @property
    def shape(self) -> tuple[int, ...]:
        """That of a part, and the number of parts."""
        return (*self.parts[0].shape, len(self.parts))

    @property
    def dtype(self) -> np.dtype[Any]:
        """That of the first part."""
        return self.parts[0].dtype

    def __getitem__(self, rows: Any) -> np.ndarray:
        return np.stack([np.asarray(part[rows]) for part in self.parts], axis=-1)


def as_text(values: np.ndarray) -> np.ndarray:
    """Texts of any stored kind as Python's."""
    return np.array([item.decode() if isinstance(item, bytes) else str(item) for item in values.flat]).reshape(
        values.shape
    )


def as_dates(values: np.ndarray) -> np.ndarray | None:
    """Dates, or texts in ISO 8601, as datetime64 in UTC; None for anything else."""
    if values.dtype.kind == "M":
        return values
    if values.dtype.kind not in "SUO":
        return None
    try:
        dates = [datetime.fromisoformat(text) if text else None for text in as_text(values).flat]
    except ValueError:
        return None
    naive = [date.astimezone(UTC).replace(tzinfo=None) if date and date.tzinfo else date for date in dates]
    return np.array(naive, "M8[us]").reshape(values.shape)


def as_times(values: np.ndarray, what: str) -> np.ndarray:
    """Times as float64, those of dates in seconds since the first; raises a DataError, naming what it is, for texts."""
    if values.dtype.kind in "biuf":
        return values.astype(np.float64)
    if values.dtype.kind == "m":
        return np.asarray(values / np.timedelta64(1, "s"))
    dates = as_dates(values)
    if dates is None:
        example = one_line(str(as_text(values).reshape(-1)[0]), 40)
        raise DataError(
            f"{what} must contain numbers, or dates such as 2026-05-31T12:00:00.5; it has {example!r}. Give seconds."
        )
    return np.asarray((dates - np.fmin.reduce(dates.reshape(-1))) / np.timedelta64(1, "s"))


def type_ids(names: np.ndarray, ids: Mapping[str, int], where: str) -> np.ndarray:
    """The ids of types by their names, in the shape of `names`; raises a DataError for a name without id."""
    unique, index = np.unique(names, return_inverse=True)
    unknown = sorted(set(unique.tolist()) - set(ids))
    if unknown:
        name = one_line(unknown[0], 40)
        raise DataError(
            f"{where}: the type {name!r} does not occur in the first run ({', '.join(ids)}); give it an id: --types"
            f" {len(ids)}={name}."
        )
    return np.array([ids[name] for name in unique.tolist()], np.int64)[index].reshape(names.shape)


def constant_axis(position: np.ndarray) -> dict[str, float]:
    """The name of the axis of three along which all of (…, 3) positions are the same, and that; else empty."""
    points = position[~np.isnan(position).any(axis=-1)]
    if position.shape[-1] != len(AXES) or len(points) < 2:
        return {}
    flat = np.flatnonzero(np.ptp(points, axis=0) == 0).tolist()
    return {AXES[axis]: float(points[0, axis]) for axis in flat} if len(flat) == 1 else {}


def plane_notes(constant: Mapping[str, float]) -> tuple[str, ...]:
    """A note for the user on the axis that is left out, if there is one."""
    kept = " and ".join(axis for axis in AXES if axis not in constant)
    return tuple(f"{axis} is {value:g} everywhere: 2-D data, of {kept}." for axis, value in constant.items())


def drop_axis(values: np.ndarray, constant: Mapping[str, float]) -> np.ndarray:
    """(…, 3) values of the axes of space without the constant axis; others as they are."""
    names = list(constant) if values.shape[-1] == len(AXES) else []
    return np.delete(values, [AXES.index(axis) for axis in names], axis=-1)


def in_plane(position: np.ndarray, dim: int, constant: Mapping[str, float], where: str) -> np.ndarray:
    """(…, D) positions of the axes that the first run has; raises a DataError if the constant axis is not one here."""
    for axis, value in constant.items() if position.shape[-1] == len(AXES) else ():
        values = position[..., AXES.index(axis)]
        other = values[(values != value) & ~np.isnan(values)]
        if other.size:
            raise DataError(
                f"{where}: {axis} is {value:g} in the first run, but not here ({other[0]:g}). Give all runs the same"
                " number of axes."
            )
    position = drop_axis(position, constant)
    if position.shape[-1] != dim:
        raise DataError(f"{where}: positions have {position.shape[-1]} axes, those of the first run have {dim}.")
    return position


def by_folder(arrays: Arrays) -> dict[str, dict[str, ArrayLike]]:
    """The arrays of each folder, by their names in it."""
    folders: dict[str, dict[str, ArrayLike]] = {}
    for name, array in arrays.items():
        folder, _, leaf = name.rpartition("/")
        folders.setdefault(folder, {})[leaf] = array
    return folders


def plain_name(name: str) -> str:
    """A name in lower case without separators."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def by_plain_name(names: Iterable[str]) -> dict[str, str]:
    """Names by their plain form; of equal ones the first."""
    return {plain_name(name): name for name in reversed(list(names))}


def with_meaning(meaning: str, names: Iterable[str]) -> list[str]:
    """Those of the names that have a meaning, the more usual ones first."""
    plain = by_plain_name(names)
    return [plain[usual] for usual in USUAL_NAMES[meaning] if usual in plain]


def component_names(plain: Mapping[str, str], meaning: str) -> tuple[str, ...]:
    """The arrays, by plain name, of the axes x, y and perhaps z of a position or velocity; () if there are none."""
    for spelling in COMPONENTS[meaning]:
        present = [plain[name] for name in takewhile(plain.__contains__, spelling)]
        if len(present) > 1:
            return tuple(present)
    return ()


def describe(arrays: Arrays, most: int = 6) -> str:
    """Names, kinds and shapes, for messages."""
    shown = [f"{name} {array.dtype} {tuple(array.shape)}" for name, array in list(arrays.items())[:most]]
    return ", ".join(shown + (["…"] if len(arrays) > most else [])) or "no array"


def can_be_positions(array: ArrayLike) -> bool:
    """Whether an array is (T, N, D) or (R, T, N, D) numbers with D = 1 to 3."""
    shape = array.shape
    return array.dtype.kind in "fiu" and len(shape) in (3, 4) and 1 <= shape[-1] <= 3 and 0 not in shape


def transposition(array: ArrayLike) -> tuple[tuple[int, ...], str] | None:
    """The axes of an array in the order of positions, and what they are in theirs; None if it cannot be positions.

    The axes of space are the last axis of 2 or 3 entries. Along time neighbours differ least; there are fewer runs than
    particles. Where none differ least, the order of the other axes is kept.
    """
    shape, numbers = tuple(array.shape), array.dtype.kind in "fiu"
    small = [axis for axis, size in enumerate(shape) if size in (2, 3)]
    if not numbers or len(shape) not in (3, 4) or not small or min(shape) < 1:
        return None
    rows = np.stack([np.asarray(array[row]) for row in range(min(shape[0], _SAMPLE))]).astype(np.float64)
    sample = rows[tuple(slice(_SAMPLE) for _ in shape)]
    others = [axis for axis in range(len(shape)) if axis != small[-1]]
    changes = [np.abs(np.diff(sample, axis=axis)) for axis in others]
    steps = [float(change[np.isfinite(change)].mean()) if np.isfinite(change).any() else np.inf for change in changes]
    order = (*others, small[-1])
    if 2 * min(steps) < sorted(steps)[1]:
        time = others[int(np.argmin(steps))]
        rest = sorted((axis for axis in others if axis != time), key=lambda axis: shape[axis])
        order = (*rest[:-1], time, rest[-1], small[-1])
    letters = dict(zip(order, "RTND"[-len(shape) :], strict=True))
    return order, ", ".join(letters[axis] for axis in range(len(shape)))


def position_name(arrays: Arrays) -> str | None:
    """Name of the positions: a usual one, or else the only floats whose shape fits; None if there are none."""
    taken = {usual for names in USUAL_NAMES.values() for usual in names}
    fitting = [
        name
        for name, array in arrays.items()
        if array.dtype.kind == "f" and can_be_positions(array) and plain_name(name) not in taken
    ]
    return usual_position(arrays) or (fitting[0] if len(fitting) == 1 else None)


def usual_position(arrays: Arrays) -> str | None:
    """Name of the positions where it is a usual one; None else."""
    return next((name for name in with_meaning("position", arrays) if can_be_positions(arrays[name])), None)


def find_roles(arrays: Arrays, position: str) -> dict[str, str]:
    """Name of the array of each meaning; its shape must fit."""
    *runs, frames, particles, dim = arrays[position].shape
    at_particles = [(particles,), (frames, particles), (particles, 1), (frames, particles, 1)]
    shapes: dict[str, list[tuple[int, ...]]] = {
        "types": [(), *at_particles, (frames,), (frames, 1)],  # (frames,) where the axes of positions are swapped
        "velocity": [(frames, particles, dim)],
        "active": at_particles,
        "id": at_particles,
        "time": [(frames,), (frames, 1)],
        "dt": [(), (1,)],
        "gravity": [(dim,), (3,)],
        "bounds": [(dim, 2), (2, dim)],
        "particle_volume": [(), (1,)],
    }

    lists = {"type_names": "SUO", "static_types": "iu", "boundary": "SUO"}  # of any length, by their kinds

    def fits(meaning: str, array: ArrayLike) -> bool:
        shape, kind = tuple(array.shape), array.dtype.kind
        if meaning in lists:
            return len(shape) == 1 and kind in lists[meaning]
        may_be_text = meaning in ("types", "active", "time", "id")
        return (kind in "biuf" or may_be_text) and any(shape in (one, (*runs, *one)) for one in shapes[meaning])

    others = [name for name in arrays if name != position]
    roles = {"position": position}
    for meaning in (*shapes, *lists):
        fitting = [name for name in with_meaning(meaning, others) if fits(meaning, arrays[name])]
        roles |= {meaning: fitting[0]} if fitting else {}
    return roles


def join_components(arrays: Arrays) -> Arrays:
    """The arrays, with x, y (and z) of equal shape (T, N) or (R, T, N) as `position`, likewise vx, vy as `velocity`."""
    joined = dict(arrays)
    fitting = [name for name, array in arrays.items() if len(array.shape) in (2, 3)]
    plain = by_plain_name(name for name in fitting if not name[-1].isdigit())  # numbers tell runs apart
    for meaning in COMPONENTS:
        names = component_names(plain, meaning)
        if meaning not in joined and len({tuple(arrays[name].shape) for name in names}) == 1:
            joined[meaning] = Components([joined.pop(name) for name in names])
    return joined
