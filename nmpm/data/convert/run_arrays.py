"""Runs made of named arrays: where they are among the arrays of a file, and the trajectory of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, get_args

import numpy as np

from nmpm.data.array_checks import check_axes
from nmpm.data.convert.base import find_split_name
from nmpm.data.convert.named_arrays import (
    ArrayLike,
    Arrays,
    as_text,
    can_be_positions,
    describe,
    find_roles,
    join_components,
    position_name,
    usual_position,
)
from nmpm.data.convert.run_files import cut
from nmpm.data.format import Trajectory
from nmpm.errors import DataError
from nmpm.scene import Boundary, Interval


@dataclass(frozen=True)
class RunArrays:
    """Arrays of one run, or of R runs that are stacked along the first axis.

    Args:
        arrays: By name.
        where: File and group, for messages.
        split: Name of the split that the names of the arrays state, or None.

    Raises:
        DataError: if none can be positions.
    """

    arrays: Arrays
    where: str
    split: str | None = None
    roles: Mapping[str, str] = field(init=False)  # name of the array of each meaning

    def __post_init__(self) -> None:
        arrays = join_components(self.arrays)
        name = position_name(arrays)
        if name is None:
            raise DataError(f"{self.where}: none of the arrays can be positions ({describe(arrays)}).")
        object.__setattr__(self, "arrays", arrays)
        object.__setattr__(self, "roles", {"position": name, **find_roles(arrays, name)})

    @property
    def stacked(self) -> bool:
        """Whether positions are (R, T, N, D)."""
        return len(self._position.shape) == 4

    @property
    def count(self) -> int:
        """Number of runs."""
        return self._position.shape[0] if self.stacked else 1

    @property
    def frames(self) -> int:
        """Number of frames of each run."""
        return self._position.shape[-3]

    @property
    def _position(self) -> ArrayLike:
        return self.arrays[self.roles["position"]]

    @cached_property
    def field_names(self) -> tuple[str, ...]:
        """Names of the further arrays that fit frames or particles."""
        others = [name for name in self.arrays if name not in self.roles.values()]
        return tuple(name for name in others if self._is_field(self.arrays[name]))

    @cached_property
    def left_out(self) -> tuple[str, ...]:
        """Names and shapes of arrays that fit neither frames nor particles."""
        rest = {
            name: array
            for name, array in self.arrays.items()
            if name not in self.roles.values() and name not in self.field_names
        }
        return tuple(f"{name} {array.dtype} {array.shape}" for name, array in rest.items())

    def _is_field(self, array: ArrayLike) -> bool:
        return array.dtype.kind in "biuf" and (self._fits(array.shape) or self._per_run(array))

    def _fits(self, shape: Sequence[int]) -> bool:
        frames, particles = self._position.shape[-3:-1]
        return not shape or shape[0] == particles or shape[0] == frames

    def _per_run(self, array: ArrayLike) -> bool:
        """Whether the first axis of an array counts the runs."""
        shape = array.shape
        if not self.stacked or not shape or shape[0] != self.count:
            return False
        return not self._fits(shape) if len(shape) == 1 else self._fits(shape[1:])

    def _take(self, name: str, run: int) -> np.ndarray:
        array = self.arrays[name]
        return np.asarray(array[run] if self._per_run(array) else array[()])

    def positions(self, run: int) -> np.ndarray:
        """The (T, N, D) positions of a run as they are stored."""
        return np.asarray(self._position[run] if self.stacked else self._position[()])

    def fact(self, meaning: str, run: int = 0) -> np.ndarray | None:
        """The array of a meaning in a run; None where there is none."""
        name = self.roles.get(meaning)
        return None if name is None else self._take(name, run)

    def stated_facts(self, dim: int) -> dict[str, Any]:
        """Fields of `Metadata` that arrays state, for data of so many axes."""
        facts: dict[str, Any] = {"particle_types": self.type_names(), "bounds": (self.bounds() or ())[:dim]}
        for name in ("dt", "particle_volume"):
            value = self.fact(name)
            if value is not None and np.isfinite(value).all() and (value > 0).all():
                facts[name] = float(value.reshape(-1)[0])
        boundary, static = self.fact("boundary"), self.fact("static_types")
        if boundary is not None and set(as_text(boundary)) <= set(get_args(Boundary)):
            facts["boundary"] = tuple(as_text(boundary).tolist()[:dim])
        if static is not None and facts["particle_types"]:
            facts["static_types"] = frozenset(static.tolist())
        return {name: value for name, value in facts.items() if value or name == "static_types"}

    def type_names(self) -> dict[int, str]:
        """Names of type ids, where types are stored as names or names beside them; else empty."""
        types, names = self.roles.get("types"), self.fact("type_names")
        if types is not None and self.arrays[types].dtype.kind in "SUO":
            return dict(enumerate(sorted(set(as_text(self.arrays[types][()]).flat))))
        return {} if names is None else {i: name for i, name in enumerate(as_text(names).tolist()) if name}

    def notes(self) -> tuple[str, ...]:
        """Sentences on what the arrays are taken for."""
        shapes = ", ".join(
            f"{meaning} {name!r} {tuple(self.arrays[name].shape)}" for meaning, name in self.roles.items()
        )
        fields = f"; fields {', '.join(self.field_names)}" if self.field_names else ""
        left_out = f" Left out, as they fit neither: {', '.join(self.left_out)}." if self.left_out else ""
        return (f"Arrays: {shapes}{fields}.{left_out}",)

    def bounds(self) -> tuple[Interval, ...] | None:
        """(lower, upper) per axis, from (D, 2) or (2, D) numbers; None where there are none that fit."""
        values, dim = self.fact("bounds"), self._position.shape[-1]
        if values is None or values.shape not in ((dim, 2), (2, dim)):
            return None
        low, high = (values if values.shape == (2, dim) and dim != 2 else values.T).astype(np.float64)
        fits = np.isfinite([low, high]).all() and (low < high).all()
        return tuple(zip(low.tolist(), high.tolist(), strict=True)) if fits else None

    def read(self, run: int, dim: int, ids: Mapping[str, int]) -> Trajectory:
        """The trajectory of a run.

        Args:
            run: Its index.
            dim: Axes to keep; those after them are 0 everywhere.
            ids: Type ids by name, where types are stored as names.

        Raises:
            DataError: if arrays do not fit together, naming the file and run.
        """
        where = f"{self.where}, run {run}" if self.stacked else self.where
        position = self.positions(run).astype(np.float32)  # a copy, in which absent particles become NaN
        types = self._types(run, position.shape[:2], ids, where)
        check_axes(position, None if types is None else types.shape[-1], where)
        position = _drop_axes(position, dim, where)
        fixed = np.zeros(position.shape[1], np.int64)
        if types is not None:
            fixed = _constant_types(types, position, where)
        self._mark_absent(run, position, where)
        try:
            trajectory = Trajectory(position, fixed, self._attributes(run, dim), self._fields(run, dim))
        except DataError as error:
            raise DataError(f"{where}: {error}") from error
        return cut(trajectory, range(len(position)))

    def _types(self, run: int, sizes: tuple[int, ...], ids: Mapping[str, int], where: str) -> np.ndarray | None:
        """(N,) or (T, N) type ids."""
        values = self.fact("types", run)
        if values is None:
            return None
        values = np.broadcast_to(values, sizes[1:]) if values.ndim == 0 else values
        if values.shape not in (sizes, sizes[1:], sizes[:1]):
            raise DataError(
                f"{where}: {self.roles['types']} {values.shape} fits neither {sizes[1]} particles nor {sizes[0]} frames"
                " of them."
            )
        if values.dtype.kind in "biuf":
            if values.dtype.kind == "f" and not (values == np.round(values)).all():
                raise DataError(f"{where}: {self.roles['types']} must be whole numbers.")
            return values.astype(np.int64)
        unknown = sorted(set(np.unique(as_text(values)).tolist()) - set(ids))
        if unknown:
            raise DataError(
                f"{where}: the type {unknown[0]!r} does not occur in the first run; give it an id: --types"
                f" {len(ids)}={unknown[0]}."
            )
        return np.array([ids[name] for name in as_text(values).flat]).reshape(values.shape)

    def _mark_absent(self, run: int, position: np.ndarray, where: str) -> None:
        active = self.fact("active", run)
        if active is None:
            return
        name = self.roles["active"]
        if not np.isin(active, (0, 1)).all():
            raise DataError(f"{where}: {name} must be 0 where a particle is absent, and 1 elsewhere.")
        if active.shape not in (position.shape[:2], position.shape[1:2]):
            raise DataError(f"{where}: {name} {active.shape} must be (T, N) = {position.shape[:2]}, or (N,).")
        position[~np.broadcast_to(active.astype(bool), position.shape[:2])] = np.nan

    def _attributes(self, run: int, dim: int) -> dict[str, Any]:
        gravity = self.fact("gravity", run)
        if gravity is None or gravity.ndim != 1 or len(gravity) < dim:
            return {}
        return {"gravity": gravity[:dim].astype(np.float64)}

    def _fields(self, run: int, dim: int) -> dict[str, np.ndarray]:
        fields = {name.replace("/", "_"): self._take(name, run) for name in self.field_names}
        velocity, time = self.fact("velocity", run), self.fact("time", run)
        if velocity is not None:
            fields["velocity"] = velocity[..., :dim].astype(np.float32)
        if time is not None:
            fields["time"] = time.astype(np.float64)
        return fields


def _constant_types(types: np.ndarray, position: np.ndarray, where: str) -> np.ndarray:
    """(N,) types; positions become NaN where the type is -1."""
    if types.ndim == 1:
        position[:, types == -1] = np.nan
        return types
    absent = types == -1
    position[absent] = np.nan
    first = (~absent).argmax(axis=0)
    fixed: np.ndarray = np.take_along_axis(types, first[None], axis=0)[0]
    changes = (types != fixed) & ~absent
    if changes.any():
        frame, particle = map(int, np.argwhere(changes)[0])
        raise DataError(
            f"{where}: the type of particle {particle} changes, to {types[frame, particle]} in frame {frame}. Types"
            " must be constant in time, but for -1 where a particle is absent."
        )
    return fixed


def _drop_axes(position: np.ndarray, dim: int, where: str) -> np.ndarray:
    if position.shape[2] < dim:
        raise DataError(f"{where}: positions have {position.shape[2]} axes, those of the first run have {dim}.")
    if position[..., dim:].any():
        raise DataError(f"{where}: z is 0 in the first run, but not here. Give all runs the same number of axes.")
    return position[..., :dim]


_RUN_WORDS = frozenset(
    {"run", "sim", "simulation", "traj", "trajectory", "arr", "sample", "case", "experiment", "rollout"}
)


def group_runs(arrays: Arrays, where: str) -> Iterator[RunArrays]:
    """The runs among arrays whose names have groups ("run0/position") or numbers ("position_0", "run0"), or neither.

    Arrays outside of the runs, such as types, belong to all of them.
    """
    folders: dict[str, dict[str, ArrayLike]] = {}
    for name, array in arrays.items():
        folder, _, leaf = name.rpartition("/")
        folders.setdefault(folder, {})[leaf] = array
    for folder, inside in folders.items():
        parts = folder.split("/")
        outside = ["/".join(parts[:depth]) for depth in range(len(parts)) if folder]
        shared = {name: array for outer in outside for name, array in folders.get(outer, {}).items()}
        shared = {name: array for name, array in shared.items() if not can_be_positions(array)}
        yield from _runs_in_folder(inside, shared, f"{where}: {folder}" if folder else where, _split_name(folder))


def _runs_in_folder(inside: Arrays, shared: Arrays, where: str, split: str | None) -> Iterator[RunArrays]:
    joined = join_components(inside)
    if usual_position(joined) is not None:
        yield RunArrays({**shared, **joined}, where, split)
        return
    groups: dict[tuple[str, ...], dict[str, ArrayLike]] = {}
    for name, array in joined.items():
        words = re.findall(r"[A-Za-z]+|\d+", name)
        key = tuple(word for word in words if word.isdigit() or _split_name(word))
        base = "_".join(word for word in words if word not in key and word.lower() not in _RUN_WORDS)
        groups.setdefault(key, {})[base or "position"] = array
    with_positions = [key for key in groups if key and position_name(join_components(groups[key])) is not None]
    for key in with_positions:
        rest = {name: array for name, array in groups.get((), {}).items() if not can_be_positions(array)}
        label = " ".join(key)
        yield RunArrays({**shared, **rest, **groups[key]}, f"{where}: {label}", split or _split_name(label))
    if not with_positions and position_name(joined) is not None:
        yield RunArrays({**shared, **joined}, where, split)


def _split_name(name: str) -> str | None:
    return find_split_name(*re.findall(r"[a-z]+", name.lower()))
