"""A restricted unpickler: reads NumPy arrays, numbers, strings and containers of them, and runs nothing else.

A pickle is a program that calls constructors by name. The reader replaces the few constructors that NumPy arrays need
by stand-ins that check their arguments; a request for any other name is an error that names it.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from nmpm.errors import DataError

_NDARRAY = "numpy.ndarray"
"""Stand-in for the class: calling it would let a pickle allocate any amount of memory."""

_KINDS = re.compile(r"[biuf][1248]|c8|c16|O8|O4|[SU]\d{1,4}")


class _Kind:
    """Stand-in for a dtype, whose own `__setstate__` does not check its argument."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = code, "="
        if not isinstance(code, str) or not _KINDS.fullmatch(code):
            raise pickle.UnpicklingError(f"an array of the kind {str(code)[:40]!r}")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, self.order, *structure = state[:5]
        if self.order not in ("<", ">", "=", "|") or any(part is not None for part in structure):
            raise pickle.UnpicklingError("a structured array")

    def read(self, data: bytes | bytearray, shape: Sequence[int], order: Literal["C", "F"] = "C") -> np.ndarray:
        """Converts bytes to an array."""
        kind = np.dtype(object if self.code.startswith("O") else self.order.replace("|", "=") + self.code)
        if kind.hasobject or len(data) != math.prod(shape) * kind.itemsize:
            raise pickle.UnpicklingError(f"{len(data)} bytes for an array of {kind} and shape {tuple(shape)}")
        return np.frombuffer(data, kind).reshape(shape, order=order)


class _Array:
    """Stand-in for an array while its pickle is read."""

    value: np.ndarray | tuple[list[Any], tuple[int, ...], bool]

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        shape, kind, fortran, data = state[-4:]
        if isinstance(data, str):
            data = data.encode("latin1")
        self.value = (
            (data, shape, fortran) if isinstance(data, list) else kind.read(data, shape, "F" if fortran else "C")
        )


def _array(kind: object, *_: object) -> _Array:
    if kind is not _NDARRAY:
        raise pickle.UnpicklingError("an array of a subclass")
    return _Array()


def _scalar(kind: _Kind, data: bytes | str) -> Any:
    return kind.read(data.encode("latin1") if isinstance(data, str) else data, (1,))[0]


def _from_buffer(data: bytes | bytearray, kind: _Kind, shape: Sequence[int], order: Literal["C", "F"]) -> np.ndarray:
    return kind.read(data, shape, order)


def _encode(text: str, encoding: str) -> bytes:
    """Decodes bytes as pickle protocols below 3 write them."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"text in {encoding}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Decodes b"" as pickle protocols below 3 write it."""
    return b""


_BASICS: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
}
_ALLOWED: Mapping[tuple[str, str], Any] = _BASICS | {
    (module, name): constructor
    for core in ("numpy.core", "numpy._core")
    for (module, name), constructor in {
        (f"{core}.multiarray", "_reconstruct"): _array,
        (f"{core}.multiarray", "scalar"): _scalar,
        (f"{core}.numeric", "_frombuffer"): _from_buffer,
    }.items()
}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it requests {module}.{name}, which arrays do not need and which is not run")
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError(f"it refers to an external object ({pid!r})")


def load_pickled(data: bytes, where: str) -> Any:
    """Reads a pickle of arrays, numbers, strings and containers of them.

    Raises:
        DataError: if it is damaged, or requests anything but the constructors of arrays.
    """
    try:
        return _resolve(_ArraysOnly(io.BytesIO(data)).load(), {})
    except Exception as error:
        reason = str(error)[:200] or type(error).__name__
        raise DataError(f"{where}: cannot be read as pickled arrays: {reason}.") from error


def _resolve(value: Any, done: dict[int, Any]) -> Any:
    """Replaces the stand-ins by arrays; an object that occurs several times is converted once."""
    if id(value) not in done:
        done[id(value)] = _resolve_one(value, done)
    return done[id(value)]


def _resolve_one(value: Any, done: dict[int, Any]) -> Any:
    if isinstance(value, dict):
        return {_resolve(key, done): _resolve(item, done) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_resolve(item, done) for item in value)
    if not isinstance(value, _Array):
        return value
    if isinstance(value.value, np.ndarray):
        return value.value
    items, shape, fortran = value.value
    array = np.empty(len(items), object)
    for place, item in enumerate(items):
        array[place] = _resolve(item, done)
    return array.reshape(shape, order="F" if fortran else "C")


def number_array(value: Any, where: str) -> np.ndarray:
    """Converts an array of numbers, or of objects that are numbers.

    Raises:
        DataError: if there is anything else.
    """
    array = np.asarray(value) if not isinstance(value, np.ndarray) else value
    if array.dtype == object:
        items = array.ravel().tolist()
        if not all(isinstance(item, int | float | np.number | np.bool_) for item in items):
            raise DataError(f"{where}: expected numbers, found objects such as {type(items[0]).__name__}.")
        array = np.array(items).reshape(array.shape)
    if array.dtype.kind not in "biuf":
        raise DataError(f"{where}: expected numbers, found {array.dtype}.")
    return array
