"""A restricted unpickler: reads NumPy arrays, numbers, strings and containers of them, and runs nothing else.

A pickle is a program that calls constructors by name. The reader replaces the few constructors that NumPy arrays need
by stand-ins that check their arguments; a request for any other name is an error that names it.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from nmpm._support.limits import PICKLE_BYTES, PICKLE_DEPTH, PICKLE_ITEMS, PICKLE_STEPS
from nmpm.errors import DataError

_NDARRAY = "numpy.ndarray"
"""Stand-in for the class: calling it would let a pickle allocate any amount of memory."""

_BLOCK = 64  # bytes

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


class _CountedSteps(dict[int, Any]):
    """The functions that execute a pickle's instructions, which raise an error after too many."""

    def __init__(self, functions: Mapping[int, Any]) -> None:
        super().__init__(functions)
        self.left = PICKLE_STEPS

    def __getitem__(self, code: int) -> Any:
        self.left -= 1
        if self.left < 0:
            raise pickle.UnpicklingError(f"more than {PICKLE_STEPS:,} instructions")
        if code not in self:
            raise pickle.UnpicklingError(f"the instruction {code:#x}, which arrays do not need")
        return super().__getitem__(code)


class _ArraysOnly(pickle._Unpickler):
    """Python's unpickler, as that in C allocates what an instruction asks for and hashes whatever becomes a key.

    Args:
        data: The pickle.
    """

    stack: list[Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self.dispatch = _CountedSteps(_instructions())  # type: ignore[misc]  # (counts for this pickle alone)
        self._size, self._encoded = len(data), 0

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it requests {module}.{name}, which arrays do not need and which is not run")
        return self._encode if name == "encode" else _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError(f"it refers to an external object ({str(pid)[:40]!r})")

    def _encode(self, text: str, encoding: str) -> bytes:
        self._encoded += len(text)
        if self._encoded > self._size:
            raise pickle.UnpicklingError("the same text several times")
        return _encode(text, encoding)

    def load_build(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], _Kind | _Array):
            raise pickle.UnpicklingError("a state of something that is not an array")
        self.stack[-1].__setstate__(state)

    def load_bytearray8(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        if size > self._size:
            raise pickle.UnpicklingError(f"{size} bytes, more than the pickle has")
        self.append(bytearray(self.read(size)))

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._update([key, value])

    def load_setitems(self) -> None:
        self._update(self.pop_mark())

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._update(items)

    def _update(self, items: list[Any]) -> None:
        """Adds keys and values, in turns, to the mapping on top of the stack."""
        keys = items[::2]
        if not isinstance(self.stack[-1], dict) or not all(isinstance(key, str | bytes | int | float) for key in keys):
            raise pickle.UnpicklingError("a mapping whose keys are neither text nor numbers")
        self.stack[-1].update(zip(keys, items[1::2], strict=True))


def _instructions() -> dict[int, Any]:
    """The function that executes each instruction that arrays need."""
    unused = (
        *(pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER),
        *(pickle.INST, pickle.OBJ, pickle.NEWOBJ, pickle.NEWOBJ_EX, pickle.EXT1, pickle.EXT2, pickle.EXT4),
    )
    checked = {
        pickle.BUILD[0]: _ArraysOnly.load_build,
        pickle.BYTEARRAY8[0]: _ArraysOnly.load_bytearray8,
        pickle.SETITEM[0]: _ArraysOnly.load_setitem,
        pickle.SETITEMS[0]: _ArraysOnly.load_setitems,
        pickle.DICT[0]: _ArraysOnly.load_dict,
    }
    codes = {code: function for code, function in pickle._Unpickler.dispatch.items() if bytes([code]) not in unused}
    return {**codes, **checked}


def load_pickled(data: bytes, where: str) -> Any:
    """Reads a pickle of arrays, numbers, strings and containers of them.

    Raises:
        DataError: if it is damaged, requests anything but the constructors of arrays, or exceeds the limits of
            `nmpm._support.limits`.
    """
    try:
        if len(data) > PICKLE_BYTES:
            raise pickle.UnpicklingError(f"more than {PICKLE_BYTES:,} bytes")
        content = _ArraysOnly(data).load()
        _check_amount(content, len(data))
        return _resolve(content, {})
    except (Exception, MemoryError) as error:
        reason = str(error)[:200] or type(error).__name__
        raise DataError(f"{where}: cannot be read as pickled arrays: {reason}.") from error


def _check_amount(content: Any, stored: int) -> None:
    """Refuses content that is much larger than its pickle, as what occurs several times is stored once.

    Raises:
        UnpicklingError: if there are too many objects, or they are nested too deep.
    """
    limit, done = PICKLE_ITEMS + 2 * stored // _BLOCK, dict[int, int]()

    def amount(value: Any, depth: int) -> int:
        """Objects, and blocks of numbers and text; each occurrence counts, but is walked once."""
        if depth > PICKLE_DEPTH:
            raise pickle.UnpicklingError(f"containers nested more than {PICKLE_DEPTH} deep")
        value = value.value if isinstance(value, _Array) else value
        if isinstance(value, np.ndarray):
            return 1 + value.nbytes // _BLOCK
        if isinstance(value, str | bytes | bytearray):
            return 1 + len(value) // _BLOCK
        if not isinstance(value, dict | list | tuple):
            return 1
        if id(value) not in done:
            items = value.values() if isinstance(value, dict) else value
            found = 1 + sum(amount(item, depth + 1) for item in items)
            if found > limit:
                raise pickle.UnpicklingError("the same objects are repeated too often")
            done[id(value)] = found
        return done[id(value)]

    amount(content, 0)


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
