"""The promises of SECURITY.md: declared sizes are checked before memory is taken; errors are typed and of one line."""

import gzip
import json
import os
import pickle
import resource
import struct
import zipfile

import h5py
import numpy as np
import pytest

from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.convert.pickles import load_pickled
from nmpm.data.format import Split, read_metadata
from nmpm.errors import DataError
from tests.data.convert import records, writers
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


def frames_of(folder, name, content):
    """A folder of three files with this content."""
    folder.mkdir(exist_ok=True)
    for frame in range(3):
        (folder / name.replace("*", str(frame))).write_bytes(content)
    return folder


def refused(source, out):
    """The error of a conversion, which takes at most 200 MB."""
    before = peak_memory()
    with pytest.raises(DataError) as error:
        convert(source, out)
    assert peak_memory() - before < 200e6
    assert "\n" not in str(error.value)
    return str(error.value)


def peak_memory():
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


ROWS = b"a 0 0 0\n" * 2000
HEADER = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty int id\nend_header\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("f_*.xyz", b"1\nProperties=pos:R:1000000000\n0 0 0\n"),
        ("f_*.xyz", b"1\nProperties=species:S:1:pos:R:3:more:R:" + b"9" * 4000 + b"\na 0 0 0\n"),
        ("f_*.xyz", b"900000000000\n\n" + ROWS),
        ("f_*.xyz", b"9" * 5000 + b"\n\n" + ROWS),
        ("f_*.xyz", b"2001\n\n" + ROWS + b"b" * 10**6 + b" 0 0 0\n"),
        ("f_*.xyz.gz", gzip.compress(b"90000000\n\n") + 100 * gzip.compress(b"\n" * 10**6)),
        ("f_*.xyz.gz", gzip.compress(b"90000000\n\n") + 400 * gzip.compress(bytes(10**6))),
        ("f_*.csv", b"x,y,name\n" + b"0,1,a\n" * 9000 + b"0,1," + b"b" * 10**6 + b"\n"),
        ("f_*.ply", HEADER % (b"ascii", 4 * 10**9) + b"0 0 0\n"),
        ("f_*.ply", HEADER % (b"binary_little_endian", 4 * 10**9) + bytes(12)),
        ("f_*.ply", HEADER % (b"ascii", 1) + b"0 0 4294967295\n"),
    ],
    ids=["columns", "width", "count", "digits", "word", "lines", "zeros", "cell", "ply", "binary ply", "integer"],
)
def test_text_that_declares_much(tmp_path, name, content):
    if name.endswith(".ply"):
        pytest.importorskip("plyfile", reason="the extra `vtk` is not installed")
    assert name.partition("*")[2] in refused(frames_of(tmp_path / "run", name, content), tmp_path / "out")


def write_vtkhdf(path, change):
    writers.write_vtkhdf(path, np.random.default_rng(0).random((4, 5, 3)), {"id": np.arange(5)})
    with h5py.File(path, "a") as file:
        change(file["VTKHDF"])
    return path


def declare(name, shape):
    def change(root):
        del root[name]
        root.create_dataset(name, shape, "i8", chunks=(min(shape[0], 1000), *shape[1:]))

    return change


def state_steps(number, *names):
    def change(root):
        root["Steps"].attrs["NSteps"] = number
        for name in names:
            declare(f"Steps/{name}", (number,))(root)

    return change


@pytest.mark.parametrize(
    "change",
    [
        state_steps(8 * 10**8, "Values", "PartOffsets", "PointOffsets"),
        state_steps(8 * 10**8),
        state_steps(-1),
        declare("NumberOfPoints", (10**9,)),
        declare("Steps/PointDataOffsets/id", (10**9,)),
        declare("Points", (20,)),
        declare("PointData/id", (20, 2, 2, 2)),
    ],
    ids=["steps", "steps stated", "negative", "points", "offsets", "shape", "axes"],
)
def test_vtkhdf_that_declares_much(tmp_path, change):
    assert "a.vtkhdf" in refused(write_vtkhdf(tmp_path / "a.vtkhdf", change), tmp_path / "out")


def test_npz_headers_that_are_no_python(tmp_path):
    text = b"{'descr': ',i8', 'fortran_order': False, 'shape': (12,), }".ljust(117) + b"\n"
    np.savez(tmp_path / "a.npz", positions=np.zeros((3, 12, 2), "f4"))
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("types.npy", b"\x93NUMPY\x01\x00v\x00" + text + bytes(96))
    assert "types" in refused(tmp_path / "a.npz", tmp_path / "out")


HOSTILE = (
    "180_untyped_a.npz", "bomb36.xyz", "nsteps_8e8.vtkhdf", "pointdata_5d.vtkhdf", "points_2d.vtkhdf", "ppoly/data",
    "quotes", "vtkcrash", "ply_overflow.ply",
)  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_recorded_hostile_files(recorded, tmp_path, name):
    source = recorded / "hostile" / name
    if source.suffix in (".vtk", ".ply", ""):  # folders hold VTK's files
        pytest.importorskip("vtkmodules", reason="the extra `vtk` is not installed")
    if source.suffix in (".vtk", ".ply"):
        source = frames_of(tmp_path / "run", f"f_*{source.suffix}", source.read_bytes())
    refused(source, tmp_path / "out")


def test_names_in_other_encodings_are_read(recorded, tmp_path):
    pytest.importorskip("vtkmodules", reason="the extra `vtk` is not installed")
    content = (recorded / "hostile" / "legacy_bytes_name.vtk").read_bytes()
    convert(frames_of(tmp_path / "run", "f_*.vtk", content), tmp_path / "out")
    assert Split(tmp_path / "out" / "train.h5").read(0).position.shape == (3, 12, 2)
