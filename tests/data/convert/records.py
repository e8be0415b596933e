"""An independent writer of TFRecords, with protocol buffers by hand and checksums bit by bit; DeepMind's datasets."""

import json
import struct
from pathlib import Path

import numpy as np

METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 7, "default_connectivity_radius": 0.015, "dim": 2,
            "dt": 0.0025, "vel_std": [1e-3, 1e-3]}  # fmt: skip


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
    types = bytes_feature(np.asarray(particle_type, "<i8").tobytes())
    steps = {
        name: [bytes_feature(np.asarray(frame, "<f4").tobytes()) for frame in frames]
        for name, frames in {"position": position, **more}.items()
    }
    return record(sequence_example({"key": integer_feature(7), "particle_type": types}, steps))


def write_records(path: Path, *records: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(records))
    return path


def made(frames: int = 8, particles: int = 4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions and types of water; the last particle is a boundary's."""
    position = np.random.default_rng(seed).uniform(0.2, 0.8, (frames, particles, 2)).astype(np.float32)
    position[:, -1] = position[0, -1]
    return position, np.array([5] * (particles - 1) + [3])


def write_dataset(folder: Path, **keys: object) -> Path:
    """A dataset of two, one and one trajectories, with further keys of its metadata."""
    for split, count in (("train", 2), ("valid", 1), ("test", 1)):
        rows = [trajectory_record(*made(seed=i), step_context=np.full((8, 6), i)) for i in range(count)]
        write_records(folder / f"{split}.tfrecord", *rows)
    (folder / "metadata.json").write_text(json.dumps(METADATA | keys))
    return folder
