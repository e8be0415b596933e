"""DeepMind's Learning-to-Simulate datasets: TFRecord files beside a `metadata.json`, read without TensorFlow.

Sanchez-Gonzalez et al., "Learning to simulate complex physics with graph networks", 2020. A record is one trajectory:
context features `particle_type` (N int64 in one string) and `key`, and per frame `position` (N·D float32 in one
string), in some datasets with further lists such as `step_context` or `force`.

A record of a TFRecord file is its length (uint64), the length's checksum (uint32), the payload and the payload's
checksum, little endian. Checksums are CRC-32C (RFC 3720, appendix B.4), rotated and shifted. A
payload is a protocol buffer, a `tf.train.SequenceExample`; of its wire format only the parts that
`tensorflow/core/example/example.proto` uses are supported.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from nmpm._support.bounded_files import check_regular
from nmpm.data.convert.base import Facts, Options, Run, RunFiles, located
from nmpm.data.format import METADATA_FILE, Metadata, Trajectory, read_metadata
from nmpm.errors import DataError

_BYTES, _FLOATS, _INTEGERS = 1, 2, 3  # fields of `Feature`

Feature = list[bytes] | NDArray[np.float32] | NDArray[np.int64]


@dataclass(frozen=True)
class SequenceExample:
    """One record."""

    context: dict[str, Feature]  # features of the whole sequence, by name
    steps: dict[str, list[Feature]]  # for each name, a feature per time step


def record_offsets(path: Path) -> list[int]:
    """Byte offsets of a file's records; raises a DataError if it is empty or cut off, or a length is damaged."""
    check_regular(path)
    size = path.stat().st_size
    offsets: list[int] = []
    with path.open("rb") as file:
        while (offset := file.tell()) < size:
            length = _length(file, path, len(offsets), offset)
            if offset + 12 + length + 4 > size:
                raise _damage_error(path, len(offsets), offset, "the file ends within it")
            offsets.append(offset)
            file.seek(length + 4, 1)
    if not offsets:
        raise DataError(f"{path}: the file has no record.")
    return offsets


def read_record(path: Path, offset: int, index: int) -> SequenceExample:
    """Reads the record at one of `record_offsets`; a DataError names its index if it is damaged."""
    with path.open("rb") as file:
        file.seek(offset)
        payload = file.read(_length(file, path, index, offset))
        checksum = file.read(4)
    if struct.pack("<I", masked_crc(payload)) != checksum:
        raise _damage_error(path, index, offset, "its checksum does not match its content")
    try:
        return _sequence_example(payload)
    except (ValueError, IndexError, MemoryError) as error:
        raise _damage_error(path, index, offset, f"it is not a tf.train.SequenceExample ({error})") from error


def masked_crc(data: bytes) -> int:
    """TFRecord's checksum of some bytes."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli)."""
    return _compiled_crc32c()(np.frombuffer(data, np.uint8))


@cache
def _compiled_crc32c() -> Callable[[NDArray[np.uint8]], int]:
    from nmpm._support.jit import jit  # takes half a second to import

    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, np.uint32(0x82F63B78) ^ (table >> 1), table >> 1).astype(np.uint32)

    @jit
    def remainder(data: NDArray[np.uint8], table: NDArray[np.uint32]) -> np.uint32:
        crc = np.uint32(0xFFFFFFFF)
        for byte in data:
            crc = table[(crc ^ byte) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
        return crc

    return lambda data: int(remainder(data, table)) ^ 0xFFFFFFFF


def _length(file: BinaryIO, path: Path, index: int, offset: int) -> int:
    """Reads a record's header; what it says is checked against the file's size by `record_offsets`."""
    header = file.read(12)
    if len(header) < 12:
        raise _damage_error(path, index, offset, "the file ends within its header")
    length, checksum = struct.unpack("<QI", header)
    if masked_crc(header[:8]) != checksum:
        raise _damage_error(path, index, offset, "the checksum of its length does not match")
    return int(length)


def _damage_error(path: Path, index: int, offset: int, why: str) -> DataError:
    return DataError(
        f"{path}: record {index}, at byte {offset}, cannot be read: {why}. Is it a complete TFRecord? Copy or"
        " download it again."
    )


def _sequence_example(payload: bytes) -> SequenceExample:
    context: dict[str, Feature] = {}
    steps: dict[str, list[Feature]] = {}
    for number, value in _fields(payload):
        for inner, entry in _fields(_bytes(value)):
            if inner != 1:
                continue
            parts = dict(_fields(_bytes(entry)))  # key and value of a map's entry
            name, content = _bytes(parts.get(1, b"")).decode("utf-8"), _bytes(parts.get(2, b""))
            if number == 1:
                context[name] = _feature(content)
            elif number == 2:
                steps[name] = [_feature(_bytes(step)) for field, step in _fields(content) if field == 1]
    return SequenceExample(context, steps)


def _feature(message: bytes) -> Feature:
    for kind, content in _fields(message):
        values = [value for number, value in _fields(_bytes(content)) if number == 1]
        if kind == _BYTES:
            return [_bytes(value) for value in values]
        if kind == _FLOATS:
            return np.frombuffer(b"".join(map(_bytes, values)), "<f4")
        if kind == _INTEGERS:  # of 64 bits in two's complement, one by one or packed into bytes
            numbers = list[int]()
            for value in values:
                if isinstance(value, int):
                    numbers.append(value)
                    continue
                position = 0
                while position < len(value):
                    number, position = _varint(value, position)
                    numbers.append(number)
            return np.array(numbers, np.uint64).astype(np.int64)
    return []


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yields number and value of each field: an integer, or bytes where it has a length or a fixed width."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, wire = key >> 3, key & 7
        if wire == 0:
            integer, position = _varint(message, position)
            yield number, integer
            continue
        if wire == 2:
            width, position = _varint(message, position)
        elif wire in (1, 5):
            width = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if position + width > len(message):
            raise ValueError("a field reaches beyond its message")
        yield number, message[position : position + width]
        position += width


def _varint(message: bytes, position: int) -> tuple[int, int]:
    """An integer of at most 64 bits, and the position after it."""
    value = shift = 0
    while True:
        byte = message[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, position
        if shift > 63:
            raise ValueError("a varint that is too long")


def _bytes(value: int | bytes) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("an integer instead of bytes")
    return value


class DeepMind(RunFiles):
    """TFRecord files with a `metadata.json` beside them."""

    summary: ClassVar[str] = "DeepMind's TFRecord files with metadata.json (Learning to Simulate)"
    patterns: tuple[str, ...] = ("*.tfrecord",)
    fixed_names: ClassVar[bool] = True
    family: ClassVar[str] = "deepmind"

    def facts(self, file: Path, options: Options) -> Facts:
        return Facts(read_metadata(file.parent, options.family or self.family))

    def runs(self, file: Path) -> Sequence[Run]:
        return [Run(file, index) for index in range(len(record_offsets(file)))]

    def read(self, file: Path, indices: Sequence[int], metadata: Metadata) -> Iterator[Trajectory]:
        offsets = record_offsets(file)
        for index in indices:
            yield _trajectory(read_record(file, offsets[index], index), metadata.dim, f"{file}: record {index}")


def _trajectory(example: SequenceExample, dim: int, where: str) -> Trajectory:
    if "position" not in example.steps or "particle_type" not in example.context:
        features = ", ".join(sorted({*example.context, *example.steps})) or "nothing"
        raise DataError(f"{where}: needs the features `particle_type` and `position`; found {features}.")
    context, steps = dict(example.context), dict(example.steps)
    particle_type = _numbers(context.pop("particle_type"), np.dtype("<i8"), f"{where}, particle_type")
    particles = len(particle_type)
    frames = [_numbers(step, np.dtype("<f4"), f"{where}, position") for step in steps.pop("position")]
    wrong = [i for i, frame in enumerate(frames) if len(frame) != particles * dim]
    if wrong or not frames or not particles:
        got = f"; frame {wrong[0]} has {len(frames[wrong[0]])}" if wrong else ""
        raise DataError(
            f"{where}: {len(frames)} frames, {particles} particles: each frame needs {particles} x {dim} numbers{got}."
            f" Is `dim` of {METADATA_FILE} right?"
        )
    attributes, fields = dict[str, object](), dict[str, np.ndarray]()
    for name, feature in context.items():
        if isinstance(feature, np.ndarray) and len(feature):
            attributes[name] = feature.item() if feature.size == 1 else feature
        elif feature:
            attributes[name] = np.bytes_(feature[0]) if len(feature) == 1 else np.array(feature)
    for name, series in steps.items():
        rows = [_numbers(step, np.dtype("<f4"), f"{where}, {name}") for step in series]
        if len(lengths := {len(row) for row in rows}) > 1:
            numbers = f"{min(lengths)} to {max(lengths)} numbers"
            raise DataError(f"{where}, {name}: frames have {numbers}; all need equally many.")
        values = np.stack(rows) if rows else np.empty((0, 0), np.float32)
        fields[name] = values.reshape(len(rows), particles, dim) if values.shape[1] == particles * dim else values
    with located(where):
        return Trajectory(np.stack(frames).reshape(len(frames), particles, dim), particle_type, attributes, fields)


def _numbers(feature: Feature, kind: np.dtype[Any], where: str) -> np.ndarray:
    """A feature's numbers, which may be packed into one string."""
    if isinstance(feature, np.ndarray):
        return feature
    if len(feature) != 1 or len(feature[0]) % kind.itemsize:
        sizes = [len(part) for part in feature[:8]]
        raise DataError(
            f"{where}: expected one string of {kind.itemsize}-byte numbers; found strings of {sizes} bytes."
        )
    return np.frombuffer(feature[0], kind)
