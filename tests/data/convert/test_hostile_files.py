"""The promises of SECURITY.md: declared sizes are checked before memory is taken; errors are typed and of one line."""

import json
import os
import pickle
import struct
import zipfile

import h5py
import numpy as np
import pytest

from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.convert.restricted_pickle import load_pickled
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError
from tests.data.convert import records
from tests.data.convert.test_dmcf import frames, packed, write

msgpack = pytest.importorskip("msgpack", reason="the extra `convert` is not installed")
zstandard = pytest.importorskip("zstandard", reason="the extra `convert` is not installed")

METADATA = {"bounds": [[0.1, 0.9]] * 2, "dt": 0.0025, "dim": 2, "sequence_length": 9, "particle_types": {"5": "water"}}
FILES = {
    "native": "test.h5", "deepmind": "test.tfrecord", "gns-npz": "test.npz", "neuralmpm": "test/sim_0.h5",
    "dmcf": "test/a.msgpack.zst", "rollout-pickle": "a.pkl",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
    return tmp_path


@pytest.mark.parametrize("format_name", FILES)
def test_pipes_are_not_opened(folder, format_name):
    path = folder / FILES[format_name]
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    with pytest.raises(DataError, match=f"{path.name} .*not a regular file"):
        open_dataset(folder, format_name, Options(dt=0.1))


@pytest.mark.parametrize(
    "data",
    [
        *(b"\x80\x05" + code + struct.pack("<Q", 2**40) + b"abc." for code in (b"\x96", b"\x8e", b"\x8d")),
        b"\x80\x02r\xff\xff\xff\xff.",
        b"\x80\x02cnumpy.core.multiarray\nscalar\nN}X\x0c\x00\x00\x00__defaults__K\x01\x85s\x86b.",
        b"\x80\x04K\x01Q.",
        pickle.dumps(np.zeros(5)).replace(b"K\x05\x85", b"J\xff\xff\xff\x7f\x85"),
    ],
)
def test_pickles_that_ask_for_much_or_change_functions(data):
    with pytest.raises(DataError, match="here: cannot be read as pickled arrays"):
        load_pickled(data, "here")


@pytest.mark.parametrize(
    "frame",
    [
        b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff" + bytes(2**20), b"\x91" * 5_000,
        msgpack.packb(frames()[0] | {b"pos": packed(np.zeros((5, 3), "f4")) | {b"type": b"(1000000,1000000)f4"}}),
        msgpack.packb(frames()[0] | {b"pos": packed(np.zeros((5, 3), "f4")) | {b"shape": [-1, 3]}}),
    ],
    ids=["list", "bytes", "depth", "type", "shape"],
)  # fmt: skip
def test_messages_that_ask_for_much(tmp_path, frame):
    (tmp_path / "a.msgpack.zst").write_bytes(zstandard.ZstdCompressor().compress(b"\xdd\xff\xff\xff\xff" + frame))
    with pytest.raises(DataError, match=r"a\.msgpack\.zst"):
        convert(tmp_path / "a.msgpack.zst", tmp_path / "out")


def test_streams_that_unpack_to_much(tmp_path):
    path = write(tmp_path / "a.msgpack.zst", frames()[:1] + [{b"pos": packed(np.zeros((300_000, 3), "f4"))}] * 80)
    with pytest.raises(DataError, match="200 times its size"):
        convert(path, tmp_path / "out")


def test_hdf5_groups_within_themselves_and_deep_ones(tmp_path):
    with h5py.File(tmp_path / "train.h5", "w") as file:
        group = file
        for _ in range(2_000):
            group = group.create_group("g")
        group["g"] = file["g"]
    with pytest.raises(DataError, match="trajectory g"):
        Split(tmp_path / "train.h5")


@pytest.mark.parametrize("name", ["position", "heat"])
@pytest.mark.parametrize("options", [{"chunks": (1, 1000, 3), "compression": "gzip"}, {}], ids=["chunks", "whole"])
def test_hdf5_shapes_without_content(tmp_path, name, options):
    with h5py.File(tmp_path / "train.h5", "w") as file:
        arrays = {"position": np.zeros((2, 5, 3)), "particle_type": np.zeros(5 if name == "heat" else 10_000, int)}
        for key in arrays.keys() - {name}:
            file[f"a/{key}"] = arrays[key]
        file.create_dataset(f"a/{name}", (100_000, 10_000, 3), "f4", **options)
    with pytest.raises(DataError, match=rf"trajectory a: {name}: has the shape .* bytes are stored"):
        Split(tmp_path / "train.h5").read_with_fields(0)


@pytest.mark.parametrize(
    ("kind", "shape", "limit", "message"),
    [
        ("'<f4'", "(4294967296, 4294967296)", 2**28, "simulation_0"),
        ("'<f4'", "(" * 3_000 + ")" * 3_000, 2**28, "simulation_0"),
        ("[('a', '<f4', (1000000, 1000000))]", "(2,)", 2**28, "simulation_0"),
        ("'<f4'", "(2,)", 10, "200 times its size"),
    ],
    ids=["shape", "depth", "kind", "zeros"],
)
def test_arrays_that_ask_for_much(folder, monkeypatch, kind, shape, limit, message):
    monkeypatch.setattr("nmpm.data.convert.array_files.expansion_limit", lambda _: limit)
    text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    with zipfile.ZipFile(folder / "train.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("simulation_0.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(8))
    with pytest.raises(DataError, match=rf"train\.npz: .*{message}"):
        convert(folder, folder / "out")


def test_records_that_ask_for_much(folder):
    header = struct.pack("<Q", 2**63)
    records.write_records(folder / "train.tfrecord", header + records.masked(header) + bytes(40))
    with pytest.raises(DataError, match=r"train\.tfrecord: record 0.*cannot be read"):
        convert(folder, folder / "out")


@pytest.mark.parametrize(
    "change",
    [
        '"dt": 1' + "0" * 400, '"more": ' + "[" * 100_000 + "]" * 100_000, '"gravity": [NaN, Infinity]',
        '"particle_types": {"1' + "0" * 400 + '": "a"}', '"more": "' + " " * 2**24 + '"',
    ],
    ids=["number", "depth", "nan", "key", "length"],
)  # fmt: skip
def test_metadata_beyond_all_bounds(tmp_path, change):
    (tmp_path / "metadata.json").write_text(json.dumps(METADATA)[:-1] + f", {change}}}")
    with pytest.raises(DataError, match=r"metadata\.json") as caught:
        read_metadata(tmp_path)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 300
