import fcntl
import os
import subprocess
import sys
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import open_dataset
from nmpm.data.format import Split, Trajectory, write_split
from nmpm.data.hdf5 import FILTERS, writable_hdf5, write_compressed
from nmpm.errors import DataError
from tests.made_up import made_up_trajectory


def trajectories(count: int = 3, frames: int = 40, particles: int = 500) -> list[Trajectory]:
    return [made_up_trajectory(frames, particles, seed) for seed in range(count)]


@pytest.fixture
def split(tmp_path: Path) -> Path:
    for name in ("train.h5", "other.h5"):
        write_split(tmp_path / name, trajectories(2, 4, 3))
    return tmp_path / "train.h5"


def store_elsewhere(file: h5py.File) -> None:
    secret = Path(file.filename).with_name("secret.bin")
    secret.write_bytes(np.arange(24, dtype=np.float32).tobytes())
    file["00001"].create_dataset("position", (4, 3, 2), np.float32, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def link_through_another_link(file: h5py.File) -> None:
    file["hidden/door"] = h5py.ExternalLink("other.h5", "/")
    file["00001/position"] = h5py.SoftLink("/hidden/door/00000/position")


def add_virtual(file: h5py.File, name: str, source: str, path: str = ".") -> None:
    layout = h5py.VirtualLayout((4, 3, 2), np.float32)
    layout[:] = h5py.VirtualSource(path, source, (4, 3, 2))
    file["00001"].create_virtual_dataset(name, layout)


def make_virtual(file: h5py.File) -> None:
    add_virtual(file, "position", "00000/position", "other.h5")


def make_chain(file: h5py.File) -> None:
    """Of virtual datasets of the same file; a ring of them would be followed without end."""
    add_virtual(file, "position", "/00001/copy")
    add_virtual(file, "copy", "/00000/position")


def link(file: h5py.File) -> None:
    file["00001/deep/er"] = h5py.ExternalLink("other.h5", "/00000/position")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (store_elsewhere, "'00001/position' is stored in another file, .*secret.bin"),
        (link, "'00001/deep/er' is an external link to 'other.h5'"),
        (link_through_another_link, "'hidden/door' is an external link"),
        (make_virtual, "'00001/position' is a virtual dataset"),
        (make_chain, "'00001/position' is a virtual dataset"),
    ],
    ids=["storage", "link", "soft", "virtual", "chain"],
)
def test_content_of_other_files_is_refused(split, change, message):
    with h5py.File(split, "a") as file:
        del file["00001/position"]
        change(file)
    with pytest.raises(DataError, match=f"{split}: {message}"):
        Split(split).read_with_fields(0)


def test_links_within_the_file_are_read(split):
    with h5py.File(split, "a") as file:
        del file["00001/particle_type"]
        file["00001/particle_type"] = h5py.SoftLink("/00000/particle_type")
    assert Split(split).read(1).particle_type.tolist() == [7, 7, 7]


def test_virtual_datasets_of_the_files_own_content_are_read(split):
    with h5py.File(split, "a", libver=("earliest", "v110")) as file:
        del file["00001/position"]
        add_virtual(file, "position", "/00000/position")
    np.testing.assert_array_equal(Split(split).read(1).position, Split(split).read(0).position)


@pytest.mark.parametrize("by", ["this program", "another program"])
def test_a_locked_file_is_named_as_such(split, by):
    with h5py.File(split, "a", locking=False) if by == "this program" else split.open() as file:
        if by == "another program":
            fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(DataError, match=r"train.h5: is locked .*HDF5_USE_FILE_LOCKING=FALSE") as caught:
            Split(split)
    assert "complete" not in str(caught.value)


WRITE = """
import resource, sys
from pathlib import Path
from nmpm.data.format import write_split
from tests.data.test_hdf5 import trajectories
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    write_split(Path(sys.argv[1]), iter(trajectories()))
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.slow), 0.999])
def test_a_full_disk_is_an_error_that_leaves_the_old_file(split, share):
    """A limit on the size of files stands for the disk; in a process of its own, since HDF5 would crash it."""
    before = split.read_bytes()
    write_split(split.with_name("whole.h5"), trajectories())
    size = int(share * split.with_name("whole.h5").stat().st_size)
    words = [sys.executable, "-c", WRITE, str(split), str(size)]
    run = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    assert run.stdout.startswith(f"DataError {split}: cannot be written (File too large): at least ")
    assert run.stdout.count("\n") == 1
    assert split.read_bytes() == before
    assert sorted(path.name for path in split.parent.iterdir()) == ["other.h5", "train.h5", "whole.h5"]


def test_writing_stops_after_the_trajectory_that_does_not_fit(tmp_path, monkeypatch):
    written, pwrite = [], os.pwrite

    def fills_up(*all_):
        if len(written) > 1:
            raise OSError(28, "No space left on device")
        return pwrite(*all_)

    def endless():
        while True:
            written.append(None)
            yield trajectories(1, 100, 5000)[0]

    monkeypatch.setattr(os, "pwrite", fills_up)
    with pytest.raises(DataError, match=r"train.h5: cannot be written \(No space left on device\).*are free"):
        write_split(tmp_path / "train.h5", endless())
    assert len(written) < 5


def test_content_that_was_not_written_can_be_read_back(tmp_path, monkeypatch):
    """HDF5 reads what it wrote; a file whose disk is full from the start still behaves like a file."""

    def full(*_):
        raise OSError(28, "No space left on device")

    values = np.random.default_rng(0).random((300, 50))
    monkeypatch.setattr(os, "pwrite", full)

    def write():
        with writable_hdf5(tmp_path / "a.h5") as (file, _):
            file.create_dataset("values", data=values, chunks=(7, 50), compression="gzip")
            file.flush()
            np.testing.assert_array_equal(file["values"][()], values)

    with pytest.raises(DataError, match="No space left"):
        write()


def stored_chunks(dataset) -> list[bytes]:
    """Shuffled, as they are before compression, whose bytes depend on the library."""
    starts = range(0, len(dataset), dataset.chunks[0])
    return [zlib.decompress(dataset.id.read_direct_chunk((start, 0))[1]) for start in starts]


@given(
    length=st.integers(1, 40), width=st.integers(1, 5), rows=st.integers(1, 40), threads=st.integers(1, 3),
    kind=st.sampled_from(["<f4", "<f8", "<i2"]), seed=st.integers(0, 99), noise=st.booleans(),
)  # fmt: skip
@settings(max_examples=20)
def test_chunks_are_those_that_hdf5_writes(tmp_path_factory, length, width, rows, threads, kind, seed, noise):
    rng = np.random.default_rng(seed)
    values = (1000 * rng.random((length, width)) if noise else rng.integers(0, 1000, (length, width))).astype(kind)
    rows = min(rows, length)
    with h5py.File(tmp_path_factory.mktemp("chunks") / "file.h5", "w") as file:
        write_compressed(file, "ours", values, rows, threads)
        file.create_dataset("theirs", data=values, chunks=(rows, width), **FILTERS)
        np.testing.assert_array_equal(file["ours"][:], values)
        assert (file["ours"].dtype, file["ours"].chunks) == (values.dtype, file["theirs"].chunks)
        assert stored_chunks(file["ours"]) == stored_chunks(file["theirs"])


def test_low_bytes_of_floats_which_are_noise_make_files_no_larger(tmp_path):
    walk = np.random.default_rng(0).normal(0, 1e-3, (200, 500, 2)).cumsum(0, dtype=np.float32)
    with h5py.File(tmp_path / "file.h5", "w") as file:
        write_compressed(file, "ours", walk, 50)
        file.create_dataset("theirs", data=walk, chunks=(50, 500, 2), **FILTERS)
        np.testing.assert_array_equal(file["ours"][:], walk)
        ours, theirs = (file[name].id.get_storage_size() for name in ("ours", "theirs"))
    assert ours < 1.05 * theirs


def test_a_filter_that_is_not_installed_is_named(tmp_path):
    properties, path = h5py.h5p.create(h5py.h5p.DATASET_CREATE), tmp_path / "a.h5"
    properties.set_chunk((4, 5, 2))
    properties.set_filter(60000, h5py.h5z.FLAG_OPTIONAL)  # nobody's
    with h5py.File(path, "w") as file:
        space, kind = h5py.h5s.create_simple((4, 5, 2)), h5py.h5t.IEEE_F32LE
        h5py.h5d.create(file.id, b"position", kind, space, properties).write_direct_chunk((0, 0, 0), bytes(160), 0)
    with pytest.raises(
        DataError, match=r"a\.h5: position is compressed by the HDF5 filter 60000.*pip install hdf5plug"
    ):
        open_dataset(path, "arrays")


def test_a_filter_of_the_plugins_is_used(tmp_path):
    plugins = pytest.importorskip("hdf5plugin")
    position = trajectories(1)[0].position
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("position", data=position, **plugins.Blosc())
    np.testing.assert_array_equal(next(open_dataset(tmp_path / "a.h5").splits["train"]()).position, position)
