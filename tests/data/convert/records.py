"""An independent writer of TFRecords: protocol buffers by hand, checksums bit by bit."""

import struct
from pathlib import Path

import numpy as np


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def masked(data: bytes) -> bytes:
    crc = crc32c(data)
    return struct.pack("<I", (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF)


def record(payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    return length + masked(length) + payload + masked(payload)


def varint(number: int) -> bytes:
    number &= 0xFFFFFFFFFFFFFFFF
    out = b""
    while number >= 0x80:
        out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
    return out + bytes([number])


def block(field: int, content: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(content)) + content


def bytes_feature(*values: bytes) -> bytes:
    return block(1, b"".join(block(1, value) for value in values))


def float_feature(values: np.ndarray) -> bytes:
    return block(2, block(1, np.asarray(values, "<f4").tobytes()))


def integer_feature(*values: int) -> bytes:
    return block(3, block(1, b"".join(map(varint, values))))


def entry(name: str, content: bytes) -> bytes:
    return block(1, block(1, name.encode()) + block(2, content))


def sequence_example(context: dict[str, bytes], steps: dict[str, list[bytes]]) -> bytes:
    first = b"".join(entry(name, feature) for name, feature in context.items())
    second = b"".join(entry(name, b"".join(block(1, f) for f in features)) for name, features in steps.items())
    return block(1, first) + block(2, second)


def trajectory_record(position: np.ndarray, particle_type: np.ndarray, **more: np.ndarray) -> bytes:
    """As DeepMind writes them; further (T, k) arrays become feature lists."""
    return record(
        sequence_example(
            {
                "key": integer_feature(7),
                "particle_type": bytes_feature(np.asarray(particle_type, "<i8").tobytes()),
            },
            {
                name: [bytes_feature(np.asarray(frame, "<f4").tobytes()) for frame in frames]
                for name, frames in {"position": position, **more}.items()
            },
        )
    )


def write_records(path: Path, *records: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(records))
    return path
