"""The promises of SECURITY.md: declared sizes are checked before memory is taken; errors are typed and of one line."""

import io
import json
import os
import pickle
import struct
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.convert.restricted_pickle import load_pickled
from nmpm.data.format import Split
from nmpm.data.metadata import read_metadata
from nmpm.errors import DataError
from tests.data.convert import records
from tests.data.convert.test_dmcf import frames, packed

msgpack = pytest.importorskip("msgpack", reason="the extra `convert` is not installed")
zstandard = pytest.importorskip("zstandard", reason="the extra `convert` is not installed")

METADATA = {"bounds": [[0.1, 0.9]] * 2, "dt": 0.0025, "dim": 2, "sequence_length": 9, "particle_types": {"5": "water"}}


@pytest.mark.parametrize(
    ("format_name", "name"),
    [
        ("native", "test.h5"),
        ("deepmind", "test.tfrecord"),
        ("gns-npz", "test.npz"),
        ("neuralmpm", "test/sim_0.h5"),
        ("dmcf", "test/a.msgpack.zst"),
        ("rollout-pickle", "a.pkl"),
    ],
)
def test_pipes_are_not_opened(tmp_path, format_name, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    os.mkfifo(tmp_path / name)
    with pytest.raises(DataError, match=f"{Path(name).name} .*not a regular file"):
        open_dataset(tmp_path, format_name, Options(dt=0.1))


@pytest.mark.parametrize(
    "data",
    [
        *(b"\x80\x05" + code + struct.pack("<Q", 2**40) + b"abc." for code in (b"\x96", b"\x8e", b"\x8d")),
        b"\x80\x02r\xff\xff\xff\xff.",
        b"\x80\x02cnumpy.core.multiarray\nscalar\nN}X\x0c\x00\x00\x00__defaults__K\x01\x85s\x86b.",
        pickle.dumps(np.zeros(5)).replace(b"K\x05\x85", b"J\xff\xff\xff\x7f\x85"),
    ],
)
def test_pickles_that_ask_for_much_or_change_functions(data):
    with pytest.raises(DataError, match="here: cannot be read"):
        load_pickled(data, "here")


@pytest.mark.parametrize(
    "frame",
    [
        *(b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff" + bytes(2**20), b"\x91" * 5_000),
        msgpack.packb(frames()[0] | {b"pos": packed(np.zeros((5, 3), "f4")) | {b"type": b"(1000000,1000000)f4"}}),
        msgpack.packb(frames()[0] | {b"pos": packed(np.zeros((5, 3), "f4")) | {b"shape": [-1, 3]}}),
    ],
)
def test_messages_that_ask_for_much(tmp_path, frame):
    (tmp_path / "a.msgpack.zst").write_bytes(zstandard.ZstdCompressor().compress(b"\xdd\xff\xff\xff\xff" + frame))
    with pytest.raises(DataError, match=r"a\.msgpack\.zst"):
        convert(tmp_path / "a.msgpack.zst", tmp_path / "out")


def test_streams_that_unpack_to_much(tmp_path):
    made = frames()[:1] + [{b"pos": packed(np.zeros((300_000, 3), "f4"))}] * 80
    (tmp_path / "a.msgpack.zst").write_bytes(zstandard.ZstdCompressor().compress(msgpack.packb(made)))
    with pytest.raises(DataError, match="200 times its size"):
        convert(tmp_path / "a.msgpack.zst", tmp_path / "out")


def test_hdf5_groups_within_themselves_and_deep_ones(tmp_path):
    with h5py.File(tmp_path / "train.h5", "w") as file:
        group = file
        for _ in range(2_000):
            group = group.create_group("g")
        group["g"] = file["g"]
    with pytest.raises(DataError, match="trajectory g"):
        Split(tmp_path / "train.h5")


@pytest.mark.parametrize("name", ["position", "heat"])
@pytest.mark.parametrize("options", [{"chunks": (1, 1000, 3), "compression": "gzip"}, {}])
def test_hdf5_shapes_without_content(tmp_path, name, options):
    with h5py.File(tmp_path / "train.h5", "w") as file:
        file["a/position"], file["a/particle_type"] = np.zeros((2, 5, 3)), np.zeros(5, int)
        if name in file["a"]:
            del file["a"][name], file["a/particle_type"]
            file.create_dataset("a/particle_type", (10_000,), "i8")
        file.create_dataset(f"a/{name}", (100_000, 10_000, 3), "f4", **options)
    with pytest.raises(DataError, match=rf"trajectory a: {name}: has the shape .* bytes are stored"):
        Split(tmp_path / "train.h5").read_with_fields(0)


def _npy(shape: str, kind: str = "'<f4'") -> bytes:
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + b"abcd"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_npy("(10**9,)"), "simulation_0"),
        (_npy("(4294967296, 4294967296)"), "simulation_0"),
        (_npy("(" * 3_000 + ")" * 3_000), "simulation_0"),
        (_npy("(2,)", "[('a', '<f4', (1000000, 1000000))]"), "simulation_0"),
        (bytes(100), "200 times its size"),
    ],
)
def test_arrays_that_ask_for_much(tmp_path, monkeypatch, content, message):
    if not message.startswith("sim"):
        monkeypatch.setattr("nmpm.data.convert.gns_npz.expansion_limit", lambda _: 10)
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    with zipfile.ZipFile(tmp_path / "train.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("simulation_0.npy", content)
    with pytest.raises(DataError, match=rf"train\.npz: .*{message}"):
        convert(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("length", [2**20, 2**40, 2**64 - 1])
def test_records_that_ask_for_much(tmp_path, length):
    header = struct.pack("<Q", length)
    records.write_records(tmp_path / "train.tfrecord", header + records.masked(header) + bytes(40))
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    with pytest.raises(DataError, match=r"train\.tfrecord: record 0.*cannot be read"):
        convert(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    "change",
    [
        '"dt": 1' + "0" * 400,
        '"more": ' + "[" * 100_000 + "]" * 100_000,
        '"more": ' + "[" * 100 + "]" * 100,
        '"particle_types": {"1' + "0" * 400 + '": "a"}',
        '"gravity": [NaN, Infinity]',
        '"more": "' + " " * 2**24 + '"',
    ],
)
def test_metadata_beyond_all_bounds(tmp_path, change):
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA)[:-1] + f", {change}}}")
    with pytest.raises(DataError, match=r"metadata\.json") as caught:
        read_metadata(tmp_path)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300


def test_nothing_is_unpickled_by_numpy(tmp_path):
    """An array of objects whose pickle would run something."""

    class Runs:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    content = io.BytesIO()
    np.save(content, np.array([Runs(), None]), allow_pickle=True)
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    with zipfile.ZipFile(tmp_path / "train.npz", "w") as archive:
        archive.writestr("simulation_0.npy", content.getvalue())
    with pytest.raises(DataError, match=r"requests pathlib\.Path\.touch|requests builtins\.getattr"):
        convert(tmp_path, tmp_path / "out")
    assert not (tmp_path / "ran").exists()
