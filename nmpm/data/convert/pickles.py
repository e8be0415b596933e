"""Formats with pickles, and the restricted unpickler that reads them.

Rollouts of DeepMind's code and its PyTorch successors are one pickle each. The `.npz` files of geoelements/gns hold an
array of objects per trajectory: members are named `simulation_trajectory_0` or `simulation_0`, and so on; each holds
(positions (T, N, D), one type or (N,) types) and in some datasets a material property, one or (N,). Newer files hold
one member, `gns_data`, with a row per trajectory.

The unpickler reads NumPy arrays, numbers, texts and containers of them, and runs nothing else.

A pickle is a program that calls constructors by name. The few that NumPy arrays need are replaced by functions that
check their arguments; a request for any other name is an error that names it.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from nmpm._support.bounded_files import read_bounded
from nmpm._support.messages import one_line
from nmpm.data.convert.array_files import NpzArray, npz_members
from nmpm.data.convert.base import Facts, Options, Run, RunFiles, located
from nmpm.data.format import METADATA_FILE, Metadata, Trajectory, read_metadata
from nmpm.data.metadata import parse_metadata
from nmpm.errors import DataError

_NDARRAY = "numpy.ndarray"
"""In place of the class, a call of which would allocate any amount of memory."""
_KINDS = re.compile(r"[biuf][1248]|c8|c16|O8|O4|[SU][1-9]\d{0,3}")


class _Kind:
    """In place of `numpy.dtype`, whose `__setstate__` does not check its argument."""

    def __init__(self, code: str, *_: object) -> None:
        if not isinstance(code, str) or not _KINDS.fullmatch(code):
            raise pickle.UnpicklingError("an array of neither numbers nor text")
        self.code, self.order = "O" if code.startswith("O") else code, "="

    def set_state(self, state: tuple[Any, ...]) -> None:
        _, self.order, *structure = state[:5]
        if self.order not in ("<", ">", "=", "|") or any(part is not None for part in structure):
            raise pickle.UnpicklingError("a structured array")

    def checked(self, content: bytes | bytearray | list[Any], shape: Sequence[int]) -> np.dtype[Any]:
        """The dtype, if it and the shape match the content: objects in a list, numbers as bytes."""
        dtype = np.dtype(self.order.replace("|", "=") + self.code)
        size = 1 if isinstance(content, list) else dtype.itemsize
        sides = all(type(side) is int and side >= 0 for side in shape)
        if not sides or dtype.hasobject != isinstance(content, list) or len(content) != math.prod(shape) * size:
            raise pickle.UnpicklingError(f"{len(content)} bytes or objects are not an array of its shape")
        return dtype


def _array(kind: object, *_: object) -> np.ndarray:
    """An empty array, which its state fills."""
    if kind is not _NDARRAY:
        raise pickle.UnpicklingError("an array of a subclass")
    return np.empty(0)


def _from_buffer(data: bytes | bytearray, kind: _Kind, shape: Sequence[int], order: Literal["C", "F"]) -> np.ndarray:
    return np.frombuffer(data, kind.checked(data, shape)).reshape(shape, order=order)


def _scalar(kind: _Kind, data: bytes | str) -> Any:
    return _from_buffer(data.encode("latin1") if isinstance(data, str) else data, kind, (1,), "C")[0]


def _encode(text: str, encoding: str) -> bytes:
    """Decodes bytes as pickle protocols below 3 write them."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("text in another encoding than latin1")
    return text.encode("latin1")


class _ArrayUnpickler(pickle._Unpickler):
    """Python's unpickler; that in C allocates what an instruction asks for."""

    stack: list[Any]
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    constructors: ClassVar[dict[str, Any]] = {
        "numpy.ndarray": _NDARRAY,
        "numpy.dtype": _Kind,
        "numpy._core.multiarray._reconstruct": _array,
        "numpy._core.multiarray.scalar": _scalar,
        "numpy._core.numeric._frombuffer": _from_buffer,
        "_codecs.encode": _encode,
        "__builtin__.bytes": lambda: b"",  # as protocols below 3 write it
    }

    def find_class(self, module: str, name: str) -> Any:
        wanted = f"{module}.{name}"
        current = wanted.replace("numpy.core.", "numpy._core.")  # NumPy 1's name
        if current not in self.constructors:
            raise pickle.UnpicklingError(f"it requests {wanted}, which arrays do not need and which is not run")
        return self.constructors[current]

    def load_build(self) -> None:
        """Sets the state of a dtype or an array, and of nothing else."""
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Kind):
            target.set_state(state)
        elif type(target) is np.ndarray:
            shape, kind, fortran, content = state[-4:]
            content = content.encode("latin1") if isinstance(content, str) else content
            target.__setstate__((1, shape, kind.checked(content, shape), bool(fortran), content))  # type: ignore[arg-type]
        else:
            raise pickle.UnpicklingError("a state of something that is not an array")

    def load_bytearray8(self) -> None:
        """Reads bytes before they are allocated."""
        (size,) = struct.unpack("<Q", self.read(8))  # type: ignore[attr-defined]
        self.stack.append(bytearray(self.read(size)))  # type: ignore[attr-defined]

    dispatch[pickle.BUILD[0]] = load_build
    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8


def load_pickled(data: bytes, where: str) -> Any:
    """Reads a pickle of arrays, numbers, texts and containers of them; a DataError if it requests anything else."""
    try:
        return _ArrayUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # a damaged pickle is a damaged program
        raise DataError(
            f"{where}: cannot be read as pickled arrays: {one_line(error) or type(error).__name__}."
        ) from error


def number_array(value: Any, where: str) -> np.ndarray:
    """An array of numbers, from one, from an array of objects that are numbers, or from a number; else a DataError."""
    if not isinstance(value, np.ndarray | np.generic | int | float):
        raise DataError(f"{where}: expected an array of numbers, found {type(value).__name__}.")
    array = np.asarray(value)
    if array.dtype == object:
        items = array.ravel().tolist()
        if not all(isinstance(item, int | float | np.number | np.bool_) for item in items):
            raise DataError(f"{where}: expected numbers, found other objects.")
        array = np.array(items).reshape(array.shape)
    if array.dtype.kind not in "biuf":
        raise DataError(f"{where}: expected an array of numbers, found {array.dtype}.")
    return array


_BYTES = 2**31
_NEEDED = ("initial_positions", "ground_truth_rollout", "particle_types", "metadata")


class RolloutPickle(RunFiles):
    """A `rollout_*.pkl` of DeepMind's code or its PyTorch successors, or a folder of them."""

    summary: ClassVar[str] = "rollouts as DeepMind's code pickles them (ground_truth_rollout, …)"
    patterns: tuple[str, ...] = ("*.pkl",)
    fixed_names: ClassVar[bool] = True
    family: ClassVar[str] = "deepmind"

    def facts(self, file: Path, options: Options) -> Facts:
        stated = _content(file)["metadata"]
        if not isinstance(stated, dict):
            raise DataError(f"{file}: metadata must map keys to values; it is {type(stated).__name__}.")
        numpy = np.ndarray | np.generic
        plain = {key: value.tolist() if isinstance(value, numpy) else value for key, value in stated.items()}
        note = (
            "The true trajectories become the positions; the predictions are kept as the field predicted_rollout, with"
            " the initial positions in front."
        )
        return Facts(parse_metadata(plain, file, options.family or self.family), notes=(note,))

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        content = _content(file)
        arrays: dict[str, np.ndarray] = {
            key: number_array(content[key], f"{file}: {key}")
            for key in ("initial_positions", "ground_truth_rollout", "predicted_rollout", "particle_types")
            if key in content
        }
        try:
            initial, types = arrays.pop("initial_positions"), arrays.pop("particle_types")
            fields = {key: np.concatenate([initial, part]).astype(np.float32) for key, part in arrays.items()}
            yield Trajectory(fields.pop("ground_truth_rollout"), types, {}, fields)
        except (ValueError, TypeError, MemoryError) as error:
            raise DataError(f"{file}: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    content = load_pickled(read_bounded(path, _BYTES), str(path))
    if not isinstance(content, dict) or not all(key in content for key in _NEEDED):
        raise DataError(f"{path}: a rollout is a dict of {', '.join(_NEEDED)}; this is something else.")
    return content


_ALL = "gns_data"


class GnsNpz(RunFiles):
    """NumPy files with a `metadata.json` beside them."""

    summary: ClassVar[str] = "NumPy files of geoelements/gns with metadata.json"
    patterns: tuple[str, ...] = ("*.npz",)
    fixed_names: ClassVar[bool] = True
    family: ClassVar[str] = "deepmind"

    def recognises(self, path: Path) -> bool:
        return super().recognises(path) and ((path if path.is_dir() else path.parent) / METADATA_FILE).is_file()

    def facts(self, file: Path, options: Options) -> Facts:
        return Facts(read_metadata(file.parent, options.family or self.family))

    def runs(self, file: Path) -> Sequence[Run]:
        return [Run(file, index) for index in range(sum(count for _, _, count in _members(file)))]

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:  # noqa: ARG002
        for array, where, count in _members(file):
            content: Any = load_pickled(array.pickled(), where) if array.dtype.hasobject else array[()]
            rows = [content] if where != f"{file}: {_ALL}" else list(content) if getattr(content, "ndim", 0) else []
            if len(rows) != count:
                raise DataError(f"{where}: its header states {count} trajectories; it holds {len(rows)}.")
            for row in rows:
                yield _trajectory(row, where)


def _members(file: Path) -> Iterator[tuple[NpzArray, str, int]]:
    """Yields each member, where it is, and its number of trajectories."""
    names = npz_members(file)
    with zipfile.ZipFile(file) as archive:
        for name in names:
            where = f"{file}: {one_line(name, 60)}"
            array = NpzArray(archive, name, where)
            yield array, where, (*array.shape, 0)[0] if name == _ALL else 1


def _trajectory(row: Any, where: str) -> Trajectory:
    parts: list[Any] = [*row] if isinstance(row, np.ndarray | list | tuple) else []
    if len(parts) not in (2, 3):
        raise DataError(
            f"{where}: expected (positions, types) or (positions, types, property); found {len(parts)} parts."
        )
    position = number_array(parts[0], f"{where}: positions")
    if position.ndim != 3:
        raise DataError(f"{where}: positions must have the shape (T, N, D); they have {position.shape}.")
    types = _per_particle(parts[1], position.shape[1], f"{where}: types").astype(np.int64)
    fields = {}
    if len(parts) == 3:
        fields["material_property"] = _per_particle(parts[2], position.shape[1], f"{where}: material property")
    with located(where):
        return Trajectory(position.astype(np.float32), types, {}, fields)


def _per_particle(value: Any, particles: int, where: str) -> np.ndarray:
    """(N,) numbers, from one per particle or one for all."""
    numbers = number_array(value, where)
    if numbers.size not in (1, particles) or numbers.ndim > 1:
        raise DataError(
            f"{where}: expected one number, or one for each of {particles} particles; found shape {numbers.shape}."
        )
    return np.broadcast_to(numbers.reshape(-1), particles).copy()
