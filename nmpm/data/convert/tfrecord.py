"""TFRecord files of `tf.train.SequenceExample`s, read without TensorFlow.

A record is its length (uint64), the length's checksum (uint32), the payload and the payload's checksum, little endian.
Checksums are CRC-32C (RFC 3720, appendix B.4), rotated and shifted as TFRecord's format asks. A payload is a protocol
buffer; of its wire format only the parts that `tensorflow/core/example/example.proto` uses are supported.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from nmpm._support.limits import RECORD_FIELDS
from nmpm._support.regular_files import check_regular
from nmpm.errors import DataError

_MASK_DELTA = 0xA282EAD8
_LARGEST = 2**33  # bytes of a record; a larger length means damage
_BYTES, _FLOATS, _INTEGERS = 1, 2, 3  # fields of `Feature`

Feature = list[bytes] | NDArray[np.float32] | NDArray[np.int64]


@dataclass(frozen=True)
class SequenceExample:
    """One record.

    Args:
        context: Features of the whole sequence, by name.
        steps: For each name, a feature per time step.
    """

    context: dict[str, Feature]
    steps: dict[str, list[Feature]]


def record_offsets(path: Path) -> list[int]:
    """Byte offsets of the records of a file; lengths are checked, payloads are skipped.

    Raises:
        DataError: if the file is cut off or a length is damaged.
    """
    check_regular(path)
    size = path.stat().st_size
    offsets: list[int] = []
    with path.open("rb") as file:
        while file.tell() < size:
            offset = file.tell()
            length = _length(file, path, len(offsets), offset)
            if offset + 12 + length + 4 > size:
                raise _damage_error(path, len(offsets), offset, "the file ends within it")
            offsets.append(offset)
            file.seek(length + 4, 1)
    return offsets


def read_record(path: Path, offset: int, index: int) -> SequenceExample:
    """Reads the record at an offset.

    Args:
        path: The file.
        offset: From `record_offsets`.
        index: Index of the record, for error messages.

    Raises:
        DataError: if the record is damaged or not a SequenceExample.
    """
    with path.open("rb") as file:
        file.seek(offset)
        length = _length(file, path, index, offset)
        payload = file.read(length)
        checksum = file.read(4)
    if len(payload) < length or len(checksum) < 4:
        raise _damage_error(path, index, offset, "the file ends within it")
    if masked_crc(payload) != struct.unpack("<I", checksum)[0]:
        raise _damage_error(path, index, offset, "its checksum does not match its content")
    try:
        return _sequence_example(payload, _Budget())
    except (ValueError, IndexError, struct.error, MemoryError) as error:
        raise _damage_error(path, index, offset, f"it is not a tf.train.SequenceExample ({error})") from error


def masked_crc(data: bytes) -> int:
    """TFRecord's checksum of some bytes."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli)."""
    return int(_compiled_crc()(np.frombuffer(data, np.uint8), _TABLE)) ^ 0xFFFFFFFF


def _make_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, np.uint32(0x82F63B78) ^ (table >> 1), table >> 1)
    return table.astype(np.uint32)


_TABLE = _make_table()


def _crc_loop(data: NDArray[np.uint8], table: NDArray[np.uint32]) -> np.uint32:
    crc = np.uint32(0xFFFFFFFF)
    for byte in data:
        crc = table[(crc ^ byte) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
    return crc


@cache
def _compiled_crc() -> Callable[[NDArray[np.uint8], NDArray[np.uint32]], np.uint32]:
    import numba  # takes half a second to import

    return numba.njit(cache=True, nogil=True)(_crc_loop)  # type: ignore[no-any-return]


def _length(file: BinaryIO, path: Path, index: int, offset: int) -> int:
    header = file.read(12)
    if len(header) < 12:
        raise _damage_error(path, index, offset, "the file ends within its header")
    length, checksum = struct.unpack("<QI", header)
    if masked_crc(header[:8]) != checksum or length > _LARGEST:
        raise _damage_error(path, index, offset, "the checksum of its length does not match")
    return int(length)


def _damage_error(path: Path, index: int, offset: int, why: str) -> DataError:
    return DataError(
        f"{path}: record {index}, at byte {offset}, cannot be read: {why}. Is it a complete TFRecord? Copy or"
        " download it again."
    )


class _Budget:
    """Raises an error after too many fields and integers of a record."""

    def __init__(self) -> None:
        self.left = RECORD_FIELDS

    def spend(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise ValueError(f"more than {RECORD_FIELDS:,} fields")


def _sequence_example(payload: bytes, budget: _Budget) -> SequenceExample:
    context: dict[str, Feature] = {}
    steps: dict[str, list[Feature]] = {}
    for number, value in _fields(payload, budget):
        for inner, entry in _fields(_bytes(value), budget):
            if inner != 1:
                continue
            name, content = _entry(_bytes(entry), budget)
            if number == 1:
                context[name] = _feature(content, budget)
            elif number == 2:
                steps[name] = [_feature(_bytes(step), budget) for field, step in _fields(content, budget) if field == 1]
    return SequenceExample(context, steps)


def _entry(message: bytes, budget: _Budget) -> tuple[str, bytes]:
    """Key and value of a map's entry."""
    parts = dict(_fields(message, budget))
    return _bytes(parts.get(1, b"")).decode("utf-8"), _bytes(parts.get(2, b""))


def _feature(message: bytes, budget: _Budget) -> Feature:
    for kind, content in _fields(message, budget):
        values = [value for number, value in _fields(_bytes(content), budget) if number == 1]
        if kind == _BYTES:
            return [_bytes(value) for value in values]
        if kind == _FLOATS:
            return np.frombuffer(b"".join(map(_bytes, values)), "<f4")
        if kind == _INTEGERS:
            return np.array([number for value in values for number in _integers(value, budget)], np.int64)
    return []


def _integers(value: int | bytes, budget: _Budget) -> Iterator[int]:
    """Yields one integer, or several packed into bytes; 64 bits in two's complement."""
    place = 0
    while isinstance(value, bytes) and place < len(value):
        budget.spend()
        number, place = _varint(value, place)
        yield number - (1 << 64) if number >> 63 else number
    if isinstance(value, int):
        yield value - (1 << 64) if value >> 63 else value


def _fields(message: bytes, budget: _Budget) -> Iterator[tuple[int, int | bytes]]:
    """Yields number and value of each field: an integer, or bytes where it has a length or a fixed width."""
    place = 0
    while place < len(message):
        budget.spend()
        key, place = _varint(message, place)
        number, wire = key >> 3, key & 7
        if wire == 0:
            integer, place = _varint(message, place)
            yield number, integer
            continue
        if wire == 2:
            width, place = _varint(message, place)
        elif wire in (1, 5):
            width = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if place + width > len(message):
            raise ValueError("a field reaches beyond its message")
        yield number, message[place : place + width]
        place += width


def _varint(message: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[place]
        value |= (byte & 0x7F) << shift
        place, shift = place + 1, shift + 7
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, place
        if shift > 63:
            raise ValueError("a varint that is too long")


def _bytes(value: int | bytes) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("an integer instead of bytes")
    return value
