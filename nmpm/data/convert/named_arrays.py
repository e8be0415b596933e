"""Meanings of arrays by their usual names and shapes: positions, types, velocities, masks, times, facts.

Arrays are anything with `shape`, `dtype` and slices along the first axis, so that files are read run by run. T frames,
N particles, D = 1 to 3 axes; R runs may be stacked in front.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

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
    "active": ("active", "isactive", "alive", "present", "exists", "mask", "valid"),
    "id": (
        "id", "ids", "particle", "particleid", "particleids", "pid", "idp", "uid", "tag", "track", "trackid",
        "globalid", "globalids",
    ),
    "time": ("time", "times", "timestamps", "t"),
    "dt": ("dt", "deltat", "framedt", "timestep", "frameinterval"),
    "gravity": ("gravity", "grav", "g"),
    "bounds": ("bounds", "box", "boundingbox", "bbox", "domain", "limits"),
    "particle_volume": ("particlevolume",),
    "type_names": ("typenames", "particletypenames", "materialnames", "names"),
    "static_types": ("statictypes",),
    "boundary": ("boundary", "boundaries", "boundaryconditions"),
}  # fmt: skip
"""Names of arrays by what they mean, in lower case without separators; the first that fits is taken."""


class ArrayLike(Protocol):
    """An array that is read when it is indexed: NumPy's, or a dataset in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Its size along each axis."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """The kind of its numbers."""

    def __getitem__(self, rows: Any, /) -> Any:
        """An index, slice or () of the first axis, as a NumPy array."""


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


def plain_name(name: str) -> str:
    """A name in lower case without separators."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def describe(arrays: Arrays, most: int = 6) -> str:
    """Names, kinds and shapes, for messages."""
    shown = [f"{name} {array.dtype} {tuple(array.shape)}" for name, array in list(arrays.items())[:most]]
    return ", ".join(shown + (["…"] if len(arrays) > most else [])) or "no array"


def can_be_positions(array: ArrayLike) -> bool:
    """Whether an array is (T, N, D) or (R, T, N, D) numbers with D = 1 to 3."""
    shape = array.shape
    return array.dtype.kind in "fiu" and len(shape) in (3, 4) and 1 <= shape[-1] <= 3 and 0 not in shape


def position_name(arrays: Arrays) -> str | None:
    """Name of the positions: a usual one, or else the only floats whose shape fits; None if there are none."""
    return usual_position(arrays) or _only_positions(arrays)


def usual_position(arrays: Arrays) -> str | None:
    """Name of the positions where it is a usual one; None else."""
    by_plain_name = _by_plain_name(arrays)
    names = [by_plain_name[usual] for usual in USUAL_NAMES["position"] if usual in by_plain_name]
    return next((name for name in names if can_be_positions(arrays[name])), None)


def _only_positions(arrays: Arrays) -> str | None:
    taken = {usual for names in USUAL_NAMES.values() for usual in names}
    fitting = [
        name
        for name, array in arrays.items()
        if array.dtype.kind == "f" and can_be_positions(array) and plain_name(name) not in taken
    ]
    return fitting[0] if len(fitting) == 1 else None


def _by_plain_name(arrays: Arrays) -> dict[str, str]:
    return {plain_name(name): name for name in reversed(list(arrays))}


def find_roles(arrays: Arrays, position: str) -> dict[str, str]:
    """Name of the array of each other meaning; its shape must fit."""
    *runs, frames, particles, dim = arrays[position].shape
    at_particles = [(particles,), (frames, particles)]
    shapes: dict[str, list[tuple[int, ...]]] = {
        "types": [(), *at_particles, (frames,)],  # (frames,) where the axes of positions are swapped
        "velocity": [(frames, particles, dim)],
        "active": at_particles,
        "time": [(frames,)],
        "dt": [(), (1,)],
        "gravity": [(dim,), (3,)],
        "bounds": [(dim, 2), (2, dim)],
        "particle_volume": [(), (1,)],
    }
    by_plain_name = {plain: name for plain, name in _by_plain_name(arrays).items() if name != position}
    roles = {}
    for meaning, allowed in shapes.items():
        fitting = [*allowed, *((*runs, *shape) for shape in allowed if runs)]
        names = [by_plain_name[usual] for usual in USUAL_NAMES[meaning] if usual in by_plain_name]
        match = next((name for name in names if tuple(arrays[name].shape) in fitting), None)
        if match is not None:
            roles[meaning] = match
    for meaning, kinds in _LISTS.items():
        names = [by_plain_name[usual] for usual in USUAL_NAMES[meaning] if usual in by_plain_name]
        lists = [name for name in names if arrays[name].dtype.kind in kinds and len(arrays[name].shape) == 1]
        if lists:
            roles[meaning] = lists[0]
    return roles


_LISTS = {"type_names": "SUO", "static_types": "iu", "boundary": "SUO"}
"""Kinds of the numbers or texts of facts that are lists of any length."""

_AXIS_NAMES: Mapping[str, tuple[str, ...]] = {
    "position": (r"{axis}", r"pos{axis}", r"position{axis}", r"p{axis}"),
    "velocity": (r"v{axis}", r"vel{axis}", r"velocity{axis}"),
}


def join_components(arrays: Arrays) -> Arrays:
    """The arrays, with x, y (and z) of equal shape (T, N) or (R, T, N) as `position`, likewise vx, vy as `velocity`."""
    joined, by_plain_name = dict(arrays), _by_plain_name(arrays)
    for meaning, patterns in _AXIS_NAMES.items():
        for pattern in patterns:
            names = [by_plain_name.get(pattern.format(axis=axis)) for axis in "xyz"]
            present = [name for name in names[: names.index(None) if None in names else 3] if name is not None]
            shapes = {tuple(arrays[name].shape) for name in present}
            if len(present) > 1 and meaning not in joined and len(shapes) == 1 and len(next(iter(shapes))) in (2, 3):
                joined[meaning] = Components([joined.pop(name) for name in present])
    return joined
