"""Small files that ask for much time or memory are refused; `nmpm._support.limits` has the limits."""

import json
import pickle
import struct
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import convert
from nmpm.data.convert.restricted_pickle import load_pickled, number_array
from nmpm.data.convert.tfrecord import masked_crc
from nmpm.data.format import Split
from nmpm.data.metadata import read_metadata
from nmpm.errors import DataError
from tests.data.convert import records
from tests.data.convert.test_dmcf import frames, packed

msgpack = pytest.importorskip("msgpack", reason="the extra `convert` is not installed")
zstandard = pytest.importorskip("zstandard", reason="the extra `convert` is not installed")

METADATA = {"bounds": [[0.1, 0.9]] * 2, "dt": 0.0025, "dim": 2, "sequence_length": 9, "particle_types": {"5": "water"}}


def shared(container: type, depth: int, width: int = 2) -> object:
    value: object = container([1] * width)
    for _ in range(depth):
        value = container([value] * width)
    return value


class TestPickles:
    @pytest.mark.parametrize("container", [list, tuple])
    @pytest.mark.parametrize(("depth", "width"), [(25, 2), (4, 200), (1, 2_000)])
    def test_shared_references_that_expand(self, container, depth, width):
        value = [shared(container, depth, width), np.zeros(10)]
        with pytest.raises(DataError, match="repeated too often"):
            load_pickled(pickle.dumps(value), "here")

    def test_an_array_that_occurs_many_times(self):
        with pytest.raises(DataError, match="repeated too often"):
            load_pickled(pickle.dumps([np.zeros(100_000)] * 2_000), "here")

    def test_a_few_shared_references_are_read(self):
        array = np.arange(5.0)
        back = load_pickled(pickle.dumps({"a": array, "b": [array, array], "c": shared(list, 3)}), "here")
        np.testing.assert_array_equal(number_array(back["b"], "here"), [array, array])

    def test_deep_containers(self):
        deep: list = []
        for _ in range(100):
            deep = [deep]
        with pytest.raises(DataError, match="nested more than"):
            load_pickled(pickle.dumps(deep), "here")

    def test_keys_that_take_long_to_hash(self):
        key: object = ()
        for _ in range(60):
            key = (key, key)
        opcodes = b"\x80\x02}" + pickle.dumps(key, 2)[2:-1]
        with pytest.raises(DataError, match="keys are neither text nor numbers"):
            load_pickled(opcodes + b"K\x01s.", "here")

    def test_a_memo_with_a_large_index(self):
        load_pickled(b"\x80\x02K\x01r\xff\xff\xff\xff.", "here")

    @pytest.mark.parametrize("code", [b"\x96", b"\x8e", b"\x8d"])
    def test_lengths_beyond_the_end(self, code):
        with pytest.raises(DataError, match="here: cannot be read"):
            load_pickled(b"\x80\x05" + code + struct.pack("<Q", 2**40) + b"abc.", "here")

    def test_instructions_without_end(self):
        with pytest.raises(DataError, match="instructions"):
            load_pickled(b"\x80\x04" + b"(" * 2_000_000, "here")

    def test_text_that_is_encoded_again_and_again(self):
        text = b"X" + struct.pack("<I", 100_000) + b"a" * 100_000 + b"q\x00"
        again = b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R"
        with pytest.raises(DataError, match="the same text several times"):
            load_pickled(b"\x80\x02](" + text + again * 50 + b"e.", "here")

    def test_states_of_functions(self):
        poisoned = b"\x80\x02cnumpy.core.multiarray\nscalar\nN}X\x0c\x00\x00\x00__defaults__K\x01\x85s\x86b."
        with pytest.raises(DataError, match="a state of something that is not an array"):
            load_pickled(poisoned, "here")


class TestDmcf:
    def write(self, path: Path, content: bytes) -> Path:
        path.write_bytes(zstandard.ZstdCompressor().compress(content))
        return path

    @pytest.mark.parametrize(
        "change",
        [{b"type": 4_000_000_000}, {b"type": b"(1000000,1000000)f4"}, {b"shape": [-1, 3]}, {b"shape": 10**9},
         {b"shape": [[5, 3]]}, {b"data": 4_000_000_000}],
    )  # fmt: skip
    def test_arrays_of_another_form(self, tmp_path, change):
        made = frames()
        made[0][b"pos"] |= change
        with pytest.raises(DataError, match="not an array as msgpack-numpy writes it"):
            convert(self.write(tmp_path / "a.msgpack.zst", msgpack.packb(made)), tmp_path / "out")

    @pytest.mark.parametrize(
        "frame",
        [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff" + bytes(2**28),
         b"\x91" * 5_000, b"\x9f" + b"\x9f" * 15 + b"\x9f" * 30_000, b"\xdc\x00\xff" + b"\x90" * 255],
        ids=["list", "map", "bytes", "deep", "many", "lists"],
    )  # fmt: skip
    def test_frames_that_ask_for_much(self, tmp_path, frame):
        with pytest.raises(DataError, match=r"a.msgpack.zst"):
            convert(self.write(tmp_path / "a.msgpack.zst", b"\xdd\xff\xff\xff\xff" + frame), tmp_path / "out")

    def test_many_frames_of_zeros(self, tmp_path):
        big = packed(np.zeros((300_000, 3), "f4"))
        made = frames()[:1] + [{b"pos": packed(np.zeros((5, 3), "f4")), b"more": big}] * 80
        with pytest.raises(DataError, match="200 times its size"):
            convert(self.write(tmp_path / "a.msgpack.zst", msgpack.packb(made)), tmp_path / "out")


class TestHdf5:
    def test_deep_groups(self, tmp_path):
        with h5py.File(tmp_path / "train.h5", "w") as file:
            group = file
            for _ in range(3_000):
                group = group.create_group("g")
        with pytest.raises(DataError, match="nested more than 8 groups deep"):
            Split(tmp_path / "train.h5")

    def test_a_group_within_itself(self, tmp_path):
        with h5py.File(tmp_path / "train.h5", "w") as file:
            group = file.create_group("a")
            group["a"] = group
        with pytest.raises(DataError, match="nested more than 8"):
            Split(tmp_path / "train.h5")

    def test_many_groups(self, tmp_path, monkeypatch):
        monkeypatch.setattr("nmpm.data.hdf5.HDF5_OBJECTS", 10)
        with h5py.File(tmp_path / "train.h5", "w") as file:
            for index in range(20):
                file.create_group(str(index))
        with pytest.raises(DataError, match="more than 10 groups"):
            Split(tmp_path / "train.h5")

    @pytest.mark.parametrize("options", [{"chunks": (1, 1000, 3)}, {"chunks": (1, 1000, 3), "compression": "gzip"}, {}])
    def test_declared_shapes_without_content(self, tmp_path, options):
        with h5py.File(tmp_path / "train.h5", "w") as file:
            file.create_dataset("a/position", (100_000, 10_000, 3), "f4", **options)
            file.create_dataset("a/particle_type", (10_000,), "i8")
        with pytest.raises(DataError, match=r"trajectory a: position: has the shape .* bytes are stored"):
            Split(tmp_path / "train.h5")

    def test_chunks_larger_than_their_dataset(self, tmp_path):
        with h5py.File(tmp_path / "train.h5", "w") as file:
            options = {"chunks": (20_000, 5_000, 3), "maxshape": (None, None, 3), "compression": "gzip"}
            file.create_dataset("a/position", (2, 5, 3), "f4", **options)
            file["a/particle_type"] = np.zeros(5, int)
        with pytest.raises(DataError, match="bytes are stored"):
            Split(tmp_path / "train.h5")

    def test_fields_without_content(self, tmp_path):
        with h5py.File(tmp_path / "train.h5", "w") as file:
            file["a/position"], file["a/particle_type"] = np.zeros((2, 5, 3)), np.zeros(5, int)
            file.create_dataset("a/heat", (10**6, 10**4), "f4", chunks=(10, 10))
        with pytest.raises(DataError, match="trajectory a: heat: has the shape"):
            Split(tmp_path / "train.h5").fields(0)


class TestNpz:
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "metadata.json").write_text(json.dumps(METADATA))
        return tmp_path

    def header(self, shape: str, kind: str = "'<f4'") -> bytes:
        text = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text

    def test_zeros(self, tmp_path):
        with zipfile.ZipFile(self.folder(tmp_path) / "train.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            for index in range(12):
                archive.writestr(f"simulation_{index}.npy", bytes(2**25 + 2**20))
        with pytest.raises(DataError, match="200 times its size"):
            convert(tmp_path, tmp_path / "out")

    @pytest.mark.parametrize("name", ["simulation_" + "7" * 5_000, "simulation_" + "7" * 4_000])
    def test_long_names(self, tmp_path, name):
        with zipfile.ZipFile(self.folder(tmp_path) / "train.npz", "w") as archive:
            archive.writestr(f"{name}.npy", b"")
        with pytest.raises(DataError, match="more than 200 characters"):
            convert(tmp_path, tmp_path / "out")

    @pytest.mark.parametrize(
        ("shape", "kind"),
        [("(" * 3_000 + ")" * 3_000, "'<f4'"), ("(-1, -1)", "'<f4'"), ("(10**9,)", "'<f4'"),
         ("(4294967296, 4294967296)", "'<f4'"),
         ("(1000000000000,)", "'V0'"), ("(2,)", "[('a', '<f4', (1000000, 1000000))]"), ("5", "5")],
    )  # fmt: skip
    def test_headers_that_lie(self, tmp_path, shape, kind):
        with zipfile.ZipFile(self.folder(tmp_path) / "train.npz", "w") as archive:
            archive.writestr("simulation_0.npy", self.header(shape, kind) + b"abcd")
        with pytest.raises(DataError, match=r"train\.npz: simulation_0"):
            convert(tmp_path, tmp_path / "out")


class TestMetadata:
    @pytest.mark.parametrize(
        ("change", "named"),
        [('"dt": 1' + "0" * 400, "dt"), ('"sequence_length": 1' + "0" * 400, "sequence_length"),
         ('"bounds": [[0, 1' + "0" * 400 + "], [0, 1]]", "bounds"),
         ('"more": ' + "[" * 100_000 + "]" * 100_000, "JSON"),
         ('"more": ' + "[" * 100 + "]" * 100, "nested"), ('"dim": 1' + "0" * 5_000, "JSON"),
         ('"particle_types": {"1' + "0" * 400 + '": "a"}', "particle_types"),
         ('"static_types": [1' + "0" * 400 + "]", "static_types"), ('"gravity": [NaN, Infinity]', "gravity")],
    )  # fmt: skip
    def test_numbers_and_nesting(self, tmp_path, change, named):
        (tmp_path / "metadata.json").write_text(json.dumps(METADATA)[:-1] + f", {change}}}")
        with pytest.raises(DataError, match=rf"metadata.json: .*{named}"):
            read_metadata(tmp_path)

    def test_size(self, tmp_path):
        (tmp_path / "metadata.json").write_text(json.dumps(METADATA | {"more": " " * 2**24}))
        with pytest.raises(DataError, match="more than 16,777,216 bytes"):
            read_metadata(tmp_path)


class TestRecords:
    def refused(self, tmp_path: Path, *content: bytes) -> str:
        folder = tmp_path / "data"
        records.write_records(folder / "train.tfrecord", *content)
        (folder / "metadata.json").write_text(json.dumps(METADATA))
        with pytest.raises(DataError, match=r"train.tfrecord: record 0") as caught:
            convert(folder, tmp_path / "out")
        return str(caught.value)

    @pytest.mark.parametrize("length", [36, 2**20, 2**33, 2**40, 2**64 - 1])
    def test_lengths_that_lie(self, tmp_path, length):
        header = struct.pack("<Q", length)
        assert "cannot be read" in self.refused(tmp_path, header + records.masked(header) + bytes(40))

    def test_fields_that_reach_beyond_the_record(self, tmp_path):
        huge = records.varint(1 << 3 | 2) + records.varint(2**62)
        assert "beyond its message" in self.refused(tmp_path, records.record(huge))

    def test_many_empty_fields(self, tmp_path):
        steps = records.block(1, b"") * 1_000_000
        content = records.block(2, records.entry("position", steps))
        length = struct.pack("<Q", len(content))
        whole = length + records.masked(length) + content + struct.pack("<I", masked_crc(content))
        assert "more than 500,000 fields" in self.refused(tmp_path, whole)
