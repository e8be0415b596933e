"""Valid files of every format, what reads them, and ways to damage them."""

import copy
import io
import json
import pickle
import random
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from nmpm.data.convert import Options, open_dataset
from nmpm.data.convert.tfrecord import masked_crc
from nmpm.data.format import Split, read_metadata, write_metadata
from nmpm.data.loading.sources import FolderSource
from tests.data.convert import records

Change = tuple[str, float, bytes]
METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 6, "dim": 2, "dt": 0.0025, "gravity": [0, -9.81],
            "particle_types": {"3": "boundary", "5": "water"}, "static_types": [3], "domain": [[0, 1], [0.1, 0.9]],
            "periodic_boundary_conditions": [False, True], "densities": {"water": 1000.0}, "vel_std": [1e-3, 1e-3],
            "particle_volume": 1e-4, "write_every": 1}  # fmt: skip


def positions(frames: int = 6, particles: int = 5, dim: int = 2) -> np.ndarray:
    rng = np.random.default_rng(0)
    start = rng.uniform(0.3, 0.7, (1, particles, dim))
    drift = 1e-3 * rng.random((frames, particles, dim)).cumsum(axis=0)
    drift[:, -1] = 0  # the last is a boundary particle
    return (start + drift).astype(np.float32)


TYPES = np.array([5, 5, 5, 5, 3])


@dataclass(frozen=True)
class Reader:
    """A format.

    Args:
        file: The file that is damaged, in the dataset's folder.
        content: Its valid content, or what is inside of it.
        read: Reads all of the dataset in a folder.
        wrap: Puts the content into the file's compression and checksums.
    """

    file: str
    content: bytes
    read: Callable[[Path], object]
    wrap: Callable[[bytes], bytes] = bytes

    def try_content(self, folder: Path, content: bytes) -> None:
        """Reads the dataset with other content of the file."""
        path = folder / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.file != "metadata.json":
            (folder / "metadata.json").write_text(json.dumps(METADATA))
        path.write_bytes(self.wrap(content))
        self.read(folder)


def damage(content: bytes, changes: list[Change]) -> bytes:
    """The content after bits are flipped, bytes inserted, overwritten or repeated, or its end cut off."""
    data = bytearray(content)
    for kind, place, extra in changes:
        at = int(place * len(data))
        if kind == "flip" and data:
            data[at % len(data)] ^= 1 << (extra[0] % 8 if extra else 0)
        elif kind == "cut":
            del data[at:]
        elif kind == "insert":
            data[at:at] = extra
        elif kind == "write":
            data[at : at + len(extra)] = extra
        elif kind == "repeat":
            data[at:at] = data[at : at + 4 * len(extra)]
    return bytes(data)


KINDS = ("flip", "flip", "flip", "cut", "insert", "write", "repeat")
BLOCKS = (
    b"\xff" * 4,
    b"\xff" * 8,
    bytes(4),
    b"\x80",
    b"\x7f\xff\xff\xff",
    b"9" * 400,
    b"[" * 200,
    b"nan",
    b"-1",
    b"1e999",
)


def random_changes(rng: random.Random) -> list[Change]:
    """One to three changes."""
    changes = []
    for _ in range(rng.randint(1, 3)):
        kind, place = rng.choice(KINDS), rng.random()
        changes.append((kind, place, rng.choice(BLOCKS) if rng.random() < 0.3 else rng.randbytes(rng.randint(1, 9))))
    return changes


def _read_foreign(folder: Path) -> None:
    dataset = open_dataset(folder, None, Options(types={5: "water"}, dt=0.0025))
    for start in dataset.splits.values():
        for trajectory in start():
            assert np.isfinite(trajectory.position).all()


def _read_native(folder: Path) -> None:
    split = Split(folder / "train.h5")
    for index in range(len(split)):
        split.read_with_fields(index)
    source = FolderSource(folder)
    recordings = source.recordings("train")
    for index in range(len(recordings)):
        assert recordings[index].frames.isfinite().all()


def _read_metadata(folder: Path) -> None:
    metadata = read_metadata(folder)
    write_metadata(folder, metadata)
    assert read_metadata(folder) == metadata
    if not (folder / "train.h5").exists():
        (folder / "train.h5").write_bytes(_hdf5())
    assert FolderSource(folder).scene.dim == metadata.dim


def _hdf5() -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w", libver=("earliest", "v108")) as opened:
        for name in ("00000", "00001"):
            group = opened.create_group(name)
            group.create_dataset("position", data=positions(), chunks=(2, 5, 2), compression="gzip", shuffle=True)
            group["particle_type"], group["heat"] = TYPES, np.ones((6, 5))
            group.attrs["gravity"] = [0.0, -9.81]
            group.attrs["seed"] = 3
    return file.getvalue()


def _neuralmpm() -> bytes:
    file = io.BytesIO()
    with h5py.File(file, "w") as opened:
        opened["particles"], opened["boundary"] = positions(), positions(particles=3)
        opened["types"], opened["grav"] = TYPES[:4].repeat(2)[:5], np.array([0.0, -9.81])
    return file.getvalue()


def _record() -> bytes:
    return records.trajectory_record(positions(), TYPES, step_context=np.ones((6, 3)))


def _checksummed(payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    return length + struct.pack("<I", masked_crc(length)) + payload + struct.pack("<I", masked_crc(payload))


def _member() -> bytes:
    pair = np.empty(2, object)
    pair[:] = positions(), TYPES
    file = io.BytesIO()
    np.save(file, pair, allow_pickle=True)
    return file.getvalue()


def _zipped(member: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("simulation_0.npy", member)
    return file.getvalue()


def _messages() -> bytes:
    import msgpack

    from tests.data.convert.test_dmcf import frames

    return bytes(msgpack.packb(frames()))


def _compressed(content: bytes) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor().compress(content)


def _rollout(protocol: int) -> bytes:
    parts = {key: positions(n) for key, n in (("initial_positions", 6), ("predicted_rollout", 4))}
    plain = METADATA | {"vel_std": np.array([1e-3, 1e-3])}
    return pickle.dumps(
        parts | {"ground_truth_rollout": positions(4), "particle_types": TYPES, "metadata": plain}, protocol
    )


def readers() -> dict[str, Reader]:
    """All formats, by name; "inside" damages what is compressed or has a checksum."""
    payload = _record()[12:-4]
    return {
        "native": Reader("train.h5", _hdf5(), _read_native),
        "metadata": Reader("metadata.json", json.dumps(METADATA).encode(), _read_metadata),
        "deepmind": Reader("train.tfrecord", _record(), _read_foreign),
        "deepmind inside": Reader("train.tfrecord", payload, _read_foreign, _checksummed),
        "gns-npz": Reader("train.npz", _zipped(_member()), _read_foreign),
        "gns-npz inside": Reader("train.npz", _member(), _read_foreign, _zipped),
        "neuralmpm": Reader("train/sim_0.h5", _neuralmpm(), _read_foreign),
        "dmcf": Reader("train/a.msgpack.zst", _compressed(_messages()), _read_foreign),
        "dmcf inside": Reader("train/a.msgpack.zst", _messages(), _read_foreign, _compressed),
        "rollout-pickle": Reader("rollout_0.pkl", _rollout(4), _read_foreign),
        "rollout-pickle 2": Reader("rollout_0.pkl", _rollout(2), _read_foreign),
    }


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(10**99, 10**120),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(["wall", "periodic", "nmpm.processors.UNet", "nmpm.processors.FNO", "stop", "goop"]),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
)
FUZZ = settings(
    max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


def places(plain, path=()):
    """Every key of nested mappings and lists."""
    items = plain.items() if isinstance(plain, dict) else enumerate(plain) if isinstance(plain, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(plain, place, value):
    """A copy of nested mappings and lists with another value at a place."""
    copied = inner = copy.deepcopy(plain)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return copied
