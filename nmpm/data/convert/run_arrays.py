"""Runs made of named arrays, of a file or in memory: where they are, and the trajectory of each."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np

from nmpm.data.array_checks import check_axes
from nmpm.data.convert.base import (
    EVERYTHING_UNKNOWN,
    Facts,
    ForeignDataset,
    Options,
    Run,
    cut,
    find_split_name,
    located,
    open_divided,
    placeholder_metadata,
)
from nmpm.data.convert.named_arrays import (
    AXES,
    CONSTANT,
    ArrayLike,
    Arrays,
    as_text,
    as_times,
    by_folder,
    can_be_positions,
    constant_axis,
    describe,
    drop_axis,
    find_roles,
    in_plane,
    join_components,
    plain_name,
    plane_notes,
    position_name,
    transposition,
    type_ids,
    usual_position,
)
from nmpm.data.convert.tables import TrackRows
from nmpm.data.format import ID, SPLITS, TRACK, Metadata, Trajectory
from nmpm.errors import DataError
from nmpm.scene import Boundary


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
        object.__setattr__(self, "roles", find_roles(arrays, name))

    @cached_property
    def _shape(self) -> tuple[int, ...]:
        """(T, N, D), or (R, T, N, D) where runs are stacked."""
        return tuple(self.arrays[self.roles["position"]].shape)

    @property
    def count(self) -> int:
        """Number of runs."""
        return math.prod(self._shape[:-3])

    @property
    def frames(self) -> int:
        """Number of frames of each run."""
        return self._shape[-3]

    @cached_property
    def field_names(self) -> tuple[str, ...]:
        """Names of the further arrays that fit frames or particles."""
        others = (name for name in self.arrays if name not in self.roles.values())
        numbers = ((name, self.arrays[name]) for name in others if self.arrays[name].dtype.kind in "biuf")
        return tuple(name for name, array in numbers if self._fits(array.shape) or self._per_run(array.shape))

    def _fits(self, shape: Sequence[int]) -> bool:
        return not shape or shape[0] in self._shape[-3:-1]

    def _per_run(self, shape: Sequence[int]) -> bool:
        """Whether the first axis of an array of this shape counts the runs."""
        runs = bool(shape) and tuple(shape[:1]) == self._shape[:-3]
        return runs and (not self._fits(shape) if len(shape) == 1 else self._fits(shape[1:]))

    def _take(self, name: str, run: int) -> np.ndarray:
        """An array in a run; (T, N, 1), (N, 1) and (T, 1) values without their last axis, but for vectors."""
        array = self.arrays[name]
        values, sizes = np.asarray(array[run] if self._per_run(array.shape) else array[()]), self._shape[-3:-1]
        shapes = (sizes, sizes[1:], sizes[:1])
        vectors = {self.roles.get(meaning) for meaning in ("position", "velocity", "bounds")}
        one = values.ndim > 1 and values.shape[-1] == 1 and values.shape not in shapes and values.shape[:-1] in shapes
        return values[..., 0] if one and name not in vectors else values

    def _fact(self, meaning: str, run: int = 0) -> np.ndarray | None:
        """The array of a meaning in a run; None where there is none."""
        return self._take(self.roles[meaning], run) if meaning in self.roles else None

    def facts(self) -> Facts:
        """Metadata from the arrays, names of those that are unknown, and notes on how arrays are read."""
        constant = constant_axis(self._position(0, self.where))
        dim = self._shape[-1] - len(constant)
        stated = self._stated(dim, constant)
        unknown = EVERYTHING_UNKNOWN - {*stated, *({"gravity"} & set(self.roles))}
        taken = {*self.roles.values(), *self.field_names}
        rest = {name: array for name, array in self.arrays.items() if name not in taken}
        shapes = (f"{meaning} {name!r} {tuple(self.arrays[name].shape)}" for meaning, name in self.roles.items())
        fields = f"; fields {', '.join(self.field_names)}" if self.field_names else ""
        left_out = f" Left out, as they fit neither: {describe(rest, len(rest))}." if rest else ""
        notes = (f"Arrays: {', '.join(shapes)}{fields}.{left_out}", *plane_notes(constant))
        metadata = placeholder_metadata(dim, **stated, extra={CONSTANT: constant} if constant else {})
        return Facts(metadata, unknown, notes)

    def _stated(self, dim: int, constant: Mapping[str, float]) -> dict[str, Any]:
        """Fields of `Metadata` that arrays state, for data of so many axes."""
        types, names, bounds = self.roles.get("types"), self._fact("type_names"), self._fact("bounds")
        facts: dict[str, Any] = {}
        if bounds is not None and bounds.shape in ((self._shape[-1], 2), (2, self._shape[-1])):
            transposed = bounds.shape == (2, self._shape[-1]) and self._shape[-1] != 2
            low, high = (bounds if transposed else bounds.T).astype(np.float64)
            if np.isfinite([low, high]).all() and (low < high).all():
                each = zip(AXES, low.tolist(), high.tolist(), strict=False)
                facts["bounds"] = tuple((lower, upper) for axis, lower, upper in each if axis not in constant)
        if types is not None and self.arrays[types].dtype.kind in "SUO":  # stored as names
            facts["particle_types"] = dict(enumerate(sorted(set(as_text(self.arrays[types][()]).flat))))
        elif names is not None:
            facts["particle_types"] = {i: name for i, name in enumerate(as_text(names).tolist()) if name}
        for name in ("dt", "particle_volume"):
            value = self._fact(name)
            if value is not None and np.isfinite(value).all() and (value > 0).all():
                facts[name] = float(value.reshape(-1)[0])
        boundary, static = self._fact("boundary"), self._fact("static_types")
        if boundary is not None and set(as_text(boundary)) <= set(get_args(Boundary)):
            facts["boundary"] = tuple(drop_axis(as_text(boundary), constant).tolist()[:dim])
        if static is not None and facts.get("particle_types"):
            facts["static_types"] = frozenset(static.tolist())
        return {name: value for name, value in facts.items() if value or name == "static_types"}

    def read(self, run: int, metadata: Metadata) -> Trajectory:
        """The trajectory of a run, with the axes and type ids of the metadata.

        Raises:
            DataError: if arrays do not fit together, naming the file and run.
        """
        where = f"{self.where}, run {run}" if self._shape[:-3] else self.where
        position, constant = self._position(run, where), metadata.extra.get(CONSTANT, {})
        types = self._types(run, position.shape[:2], metadata, where)
        check_axes(position, None if types is None else types.shape[-1], where)
        position = in_plane(position, metadata.dim, constant, where)
        types = np.zeros(position.shape[1], np.int64) if types is None else types
        gravity, attributes = self._fact("gravity", run), {}
        if gravity is not None and gravity.ndim == 1 and len(gravity) >= metadata.dim:
            attributes = {"gravity": drop_axis(gravity, constant)[: metadata.dim].astype(np.float64)}
        fields = {name.replace("/", "_"): self._take(name, run) for name in self.field_names}
        velocity, time = self._fact("velocity", run), self._fact("time", run)
        if velocity is not None:
            fields["velocity"] = drop_axis(velocity, constant).astype(np.float32)
        if time is not None:
            fields["time"] = as_times(time, f"{where}: {self.roles['time']}")
        ids = self._ids(run, fields, position)
        with located(where):
            if ids is not None and ids.ndim == 2:
                return replace(_by_ids(ids, position, types, fields, where), attributes=attributes)
            fields |= {} if ids is None else {ID: ids}
            if types.ndim == 2:  # -1 where a particle is absent
                absent = types == -1
                fixed = np.take_along_axis(types, absent.argmin(axis=0)[None], axis=0)[0]
                if (changes := (types != fixed) & ~absent).any():
                    frame, particle = map(int, np.argwhere(changes)[0])
                    raise DataError(
                        f"the type of particle {particle} changes, to {types[frame, particle]} in frame {frame}. Types"
                        " must be constant in time, but for -1 where a particle is absent."
                    )
                types = fixed
            trajectory = Trajectory(position, types, attributes, fields)
        return cut(trajectory, range(len(position)))

    def _ids(self, run: int, fields: dict[str, np.ndarray], position: np.ndarray) -> np.ndarray | None:
        """(N,) ids of the columns, (T, N) where columns hold other particles in other frames; None if there are none.

        Ids are whole numbers or texts that differ between the particles of a frame. Other numbers, and those of columns
        that hold particles one after the other, are left to the fields.
        """
        ids = self._fact("id", run)
        if ids is None:
            return None
        there = ~np.isnan(position[..., 0])
        ids = np.char.encode(ids, "utf-8") if ids.dtype.kind == "U" else ids
        in_frames = np.broadcast_to(ids, there.shape)
        whole = ids.dtype.kind != "f" or bool((in_frames == np.round(in_frames))[there].all())
        if (
            plain_name(self.roles["id"]) == TRACK
            or not whole
            or any(len(np.unique(row[here])) < here.sum() for row, here in zip(in_frames, there, strict=True))
        ):
            fields[self.roles["id"]] = ids
            return None
        first = np.take_along_axis(in_frames, there.argmax(axis=0)[None], axis=0)[0]
        ids = first if ((ids == first) | ~there).all() else ids
        return ids.astype(np.int64) if ids.dtype.kind == "f" else ids

    def _position(self, run: int, where: str) -> np.ndarray:
        """(T, N, D) float32 positions, NaN where a mask of 0 or a type of -1 says that a particle is absent."""
        position = self._take(self.roles["position"], run).astype(np.float32)
        sizes, active, types = position.shape[:2], self._fact("active", run), self._fact("types", run)
        if active is not None:
            name = self.roles["active"]
            if not np.isin(active, (0, 1)).all():
                raise DataError(f"{where}: {name} must be 0 where a particle is absent, and 1 elsewhere.")
            if active.shape not in (sizes, sizes[1:]):
                raise DataError(f"{where}: {name} {active.shape} must be (T, N) = {sizes}, or (N,).")
            position[~np.broadcast_to(active.astype(bool), sizes)] = np.nan
        if types is not None and types.dtype.kind in "if" and types.shape in (sizes, sizes[1:]):
            position[np.broadcast_to(types == -1, sizes)] = np.nan
        return position

    def _types(self, run: int, sizes: tuple[int, ...], metadata: Metadata, where: str) -> np.ndarray | None:
        """(N,) or (T, N) type ids."""
        values = self._fact("types", run)
        if values is None:
            return None
        name = self.roles["types"]
        values = np.broadcast_to(values, sizes[1:]) if values.ndim == 0 else values
        if values.shape not in (sizes, sizes[1:], sizes[:1]):
            raise DataError(
                f"{where}: {name} {values.shape} fits neither {sizes[1]} particles nor {sizes[0]} frames of them."
            )
        if values.dtype.kind not in "biuf":
            return type_ids(as_text(values), {name: i for i, name in metadata.particle_types.items()}, where)
        if values.dtype.kind == "f" and not (values == np.round(values)).all():
            raise DataError(f"{where}: {name} must be whole numbers.")
        return values.astype(np.int64)


def _by_ids(
    ids: np.ndarray, position: np.ndarray, types: np.ndarray, fields: Mapping[str, np.ndarray], where: str
) -> Trajectory:
    """The trajectory of (T, N) particles that are in any order in each frame."""
    there = ~np.isnan(position[..., 0])
    frame, _ = np.nonzero(there)
    at_particles = {name: values[there] for name, values in fields.items() if values.shape[:2] == ids.shape}
    time, velocity = fields.get("time"), at_particles.pop("velocity", None)
    rows = TrackRows(
        row=np.arange(len(frame)),
        position=position[there],
        track=ids[there],
        key=frame.astype(np.float64),
        time=None if time is None else time[frame],
        types=np.broadcast_to(types, ids.shape)[there],
        values={name: values for name, values in at_particles.items() if values.ndim == 1},
        velocity=velocity,
    )
    trajectory = rows.trajectory(where)
    others = {name: values for name, values in fields.items() if name not in {*at_particles, "time", "velocity"}}
    return replace(trajectory, fields=others | trajectory.fields)


_RUN_WORDS = frozenset(
    {"run", "sim", "simulation", "traj", "trajectory", "arr", "sample", "case", "experiment", "rollout"}
)


def group_runs(arrays: Arrays, where: str) -> Iterator[RunArrays]:
    """The runs among arrays whose names have groups ("run0/position") or numbers ("position_0", "run0"), or neither.

    Arrays outside of the runs, such as types, belong to all of them.
    """
    folders = by_folder(arrays)
    for folder, inside in folders.items():
        parts = folder.split("/")
        outside = ["/".join(parts[:depth]) for depth in range(len(parts)) if folder]
        around = {name: array for outer in outside for name, array in folders.get(outer, {}).items()}
        shared = {name: array for name, array in around.items() if not can_be_positions(array)}
        place, split = f"{where}: {folder}" if folder else where, _split_name(folder)
        joined = join_components(inside)
        if usual_position(joined) is not None:
            yield RunArrays({**shared, **joined}, place, split)
            continue
        groups: dict[tuple[str, ...], dict[str, ArrayLike]] = {}
        for name, array in joined.items():
            words = re.findall(r"[A-Za-z]+|\d+", name)
            key = tuple(word for word in words if word.isdigit() or _split_name(word))
            base = "_".join(word for word in words if word not in key and word.lower() not in _RUN_WORDS)
            groups.setdefault(key, {})[base or "position"] = array
        with_positions = [key for key in groups if key and position_name(join_components(groups[key])) is not None]
        rest = {name: array for name, array in groups.get((), {}).items() if not can_be_positions(array)}
        for key in with_positions:
            label = " ".join(key)
            yield RunArrays({**shared, **rest, **groups[key]}, f"{place}: {label}", split or _split_name(label))
        if not with_positions and position_name(joined) is not None:
            yield RunArrays({**shared, **joined}, place, split)


def _split_name(name: str) -> str | None:
    return find_split_name(*re.findall(r"[a-z]+", name.lower()))


RunInMemory = np.ndarray | Mapping[str, np.ndarray]
Runs = np.ndarray | Iterable[Trajectory | RunInMemory]
"""Runs as a (R, T, N, D) array, or one by one: (T, N, D) positions, arrays by name, or trajectories."""


def open_runs(runs: Runs | Mapping[str, Runs], options: Options) -> ForeignDataset:
    """The dataset of runs in memory: by split as a dict states them, else divided by `divide`.

    Raises:
        DataError: if there are none, or arrays do not fit together; names the run.
        ConfigError: if an option is invalid.
    """
    divided = isinstance(runs, Mapping) and set(runs) <= set(SPLITS)
    parts: Mapping[str, Any] = runs if isinstance(runs, Mapping) and divided else {"all": runs}
    splits = {name: list(_each(part, f"{name} " if divided else "")) for name, part in parts.items()}
    first = next((part[0].source for part in splits.values() if part), None)
    if first is None:
        raise DataError("There are no runs to write.")
    if isinstance(first, RunArrays):
        facts = first.facts()
    elif first.metadata is not None:
        facts = Facts(first.metadata)
    else:
        facts = Facts(placeholder_metadata(first.position.shape[2]), EVERYTHING_UNKNOWN)

    def read(runs: Sequence[Run], metadata: Metadata) -> Iterator[Trajectory]:
        for run in runs:
            whole = run.source if isinstance(run.source, Trajectory) else run.source.read(run.index, metadata)
            yield whole if run.part is None else cut(whole, run.part)

    return open_divided(splits, facts, read, options)


def _each(runs: Runs | Mapping[str, Any], where: str) -> Iterator[Run]:
    """The runs, with their trajectories or arrays as the source, and their number as the file."""
    items = [runs] if isinstance(runs, Mapping | np.ndarray | Trajectory) else runs
    for number, item in enumerate(items):
        name = f"{where}run {number}"
        if isinstance(item, Trajectory):
            yield Run(Path(name), 0, len(item.position), source=item)
            continue
        named = item if isinstance(item, Mapping) else {"position": item}
        arrays = {key: np.asarray(array) for key, array in named.items()}
        groups = list(group_runs(arrays, name))
        if not groups:
            shapes = ", ".join(f"{key} {array.shape}" for key, array in arrays.items())
            found = transposition(max(arrays.values(), key=np.size))
            mend = "" if found is None else f" Its axes look like ({found[1]}): np.transpose(…, {found[0]})."
            raise DataError(f"{name}: none of the arrays is (T, N, D) or (R, T, N, D) positions ({shapes}).{mend}")
        for group in groups:
            yield from (Run(Path(name), index, group.frames, source=group) for index in range(group.count))
