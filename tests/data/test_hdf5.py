import fcntl
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm._support.regular_files import check_regular
from nmpm.data.convert import FORMATS, Options
from nmpm.data.format import METADATA_FILE, Split, Trajectory, read_metadata, write_split
from nmpm.data.hdf5 import check_self_contained, open_hdf5, writable_hdf5
from nmpm.errors import DataError
from tests.made_up import made_up_trajectory


def trajectories(count: int = 3, frames: int = 40, particles: int = 500) -> list[Trajectory]:
    return [made_up_trajectory(frames, particles, seed) for seed in range(count)]


@pytest.fixture
def split(tmp_path: Path) -> Path:
    path = tmp_path / "train.h5"
    write_split(path, trajectories(2, 4, 3))
    return path


class TestSelfContained:
    def refused(self, path: Path) -> str:
        with pytest.raises(DataError) as caught:
            Split(path).read_with_fields(0)
        assert str(path) in str(caught.value)
        return str(caught.value)

    def test_external_storage(self, split):
        secret = split.with_name("secret.bin")
        secret.write_bytes(np.arange(24, dtype=np.float32).tobytes())
        with h5py.File(split, "a") as file:
            del file["00001/position"]
            storage = [(str(secret), 0, h5py.h5f.UNLIMITED)]
            file["00001"].create_dataset("position", (4, 3, 2), np.float32, external=storage)
        message = self.refused(split)
        assert "00001/position" in message
        assert "secret.bin" in message

    @pytest.mark.parametrize("name", ["00001", "00001/position", "00001/temperature", "00001/deep/er"])
    def test_external_link(self, split, name):
        write_split(split.with_name("other.h5"), trajectories(2, 4, 3))
        with h5py.File(split, "a") as file:
            if name in file:
                del file[name]
            file[name] = h5py.ExternalLink("other.h5", "/00000/position")
        message = self.refused(split)
        assert f"'{name}'" in message
        assert "external link to 'other.h5'" in message

    def test_soft_link_through_an_external_one(self, split):
        write_split(split.with_name("other.h5"), trajectories(2, 4, 3))
        with h5py.File(split, "a") as file:
            file["hidden/door"] = h5py.ExternalLink("other.h5", "/")
            file["00002"] = h5py.SoftLink("/hidden/door/00000")
        assert "'hidden/door'" in self.refused(split)

    def test_virtual_dataset(self, split):
        layout = h5py.VirtualLayout((4, 3, 2), np.float32)
        layout[:] = h5py.VirtualSource("other.h5", "00000/position", (4, 3, 2))
        with h5py.File(split, "a") as file:
            del file["00000/position"]
            file["00000"].create_virtual_dataset("position", layout)
        assert "'00000/position' is a virtual dataset" in self.refused(split)

    def test_links_within_the_file_are_read(self, split):
        with h5py.File(split, "a") as file:
            del file["00001/particle_type"]
            file["00001/particle_type"] = h5py.SoftLink("/00000/particle_type")
        assert Split(split).read(1).particle_type.tolist() == [7, 7, 7]

    def test_foreign_files(self, tmp_path):
        folder = tmp_path / "train"
        folder.mkdir()
        with h5py.File(folder / "sim_0.h5", "w") as file:
            file["particles"] = h5py.ExternalLink("/etc/passwd", "/")
        with pytest.raises(DataError, match=r"sim_0.h5: 'particles' is an external link"):
            next(kind for kind in FORMATS if kind.name == "neuralmpm").open(tmp_path, Options(dt=0.1))


class TestLocks:
    def refused(self, path: Path) -> None:
        with pytest.raises(DataError, match=r"train.h5: is locked .*HDF5_USE_FILE_LOCKING=FALSE") as caught:
            Split(path)
        assert "complete" not in str(caught.value)

    def test_a_file_that_this_program_has_open_with_other_locks(self, split):
        with h5py.File(split, "a", locking=False):
            self.refused(split)

    def test_a_file_that_another_program_locks(self, split):
        with split.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            self.refused(split)


class TestRegularFiles:
    def test_regular_files_and_links_to_them_pass(self, split):
        link = split.with_name("valid.h5")
        link.symlink_to(split)
        check_regular(link)
        assert len(Split(link)) == 2

    @pytest.mark.parametrize("name", ["train.h5", "valid.h5"])
    def test_split(self, tmp_path, name):
        os.mkfifo(tmp_path / name)
        with pytest.raises(DataError, match=f"{name}: is a FIFO, not a regular file"):
            Split(tmp_path / name)

    def test_metadata(self, tmp_path):
        os.mkfifo(tmp_path / METADATA_FILE)
        with pytest.raises(DataError, match=r"metadata.json: is a FIFO"):
            read_metadata(tmp_path)

    @pytest.mark.parametrize("device", ["/dev/zero", "/dev/null"])
    def test_device(self, tmp_path, device):
        (tmp_path / "train.h5").symlink_to(device)
        with pytest.raises(DataError, match=r"train.h5: is a character device"):
            Split(tmp_path / "train.h5")

    @pytest.mark.parametrize(
        ("format_name", "file"),
        [
            ("native", "train.h5"),
            ("deepmind", "train.tfrecord"),
            ("gns-npz", "train.npz"),
            ("neuralmpm", "train/sim_0.h5"),
            ("dmcf", "train/a.msgpack.zst"),
            ("rollout-pickle", "rollout_0.pkl"),
        ],
    )
    def test_every_format(self, make_dataset, format_name, file):
        folder = make_dataset(train=(), valid=(), test=())
        (folder / file).parent.mkdir(exist_ok=True)
        os.mkfifo(folder / file)
        kind = next(kind for kind in FORMATS if kind.name == format_name)
        with pytest.raises(DataError, match=rf"{Path(file).name}: is a FIFO, not a regular file"):
            kind.open(folder, Options(family="deepmind", dt=0.1))


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


class TestFullDisk:
    @pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
    def test_is_an_error_that_leaves_nothing(self, tmp_path, share):
        """A limit on the size of files stands for the disk; in a process of its own, since HDF5 would crash it."""
        write_split(tmp_path / "whole.h5", trajectories())
        size = (tmp_path / "whole.h5").stat().st_size
        target = tmp_path / "folder" / "train.h5"
        words = [sys.executable, "-c", WRITE, str(target), str(int(share * size))]
        run = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
        assert run.returncode == 0, run.stderr[-2000:]
        assert run.stdout.startswith(f"DataError {target}: cannot be written (File too large): at least ")
        assert run.stdout.count("\n") == 1
        assert not list(target.parent.iterdir())

    def test_the_old_file_stays(self, split, monkeypatch):
        before = split.read_bytes()

        def full(*_: object) -> int:
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, "pwrite", full)
            with pytest.raises(DataError, match=r"train.h5: cannot be written \(No space left on device\).*are free"):
                write_split(split, iter(trajectories()))
        assert split.read_bytes() == before
        assert [path.name for path in split.parent.iterdir()] == ["train.h5"]

    def test_stops_after_the_trajectory_that_does_not_fit(self, tmp_path, monkeypatch):
        written, pwrite = [], os.pwrite

        def fills_up(descriptor: int, data: bytes, offset: int) -> int:
            if len(written) > 1:
                raise OSError(28, "No space left on device")
            return pwrite(descriptor, data, offset)

        def endless():
            while True:
                written.append(None)
                yield trajectories(1, 100, 5000)[0]

        monkeypatch.setattr(os, "pwrite", fills_up)
        with pytest.raises(DataError, match="No space left"):
            write_split(tmp_path / "train.h5", endless())
        assert len(written) < 5

    def test_errors_of_the_source_pass_unchanged(self, tmp_path):
        def broken():
            yield trajectories(1)[0]
            raise OSError("the source is gone")

        with pytest.raises(OSError, match="the source is gone"):
            write_split(tmp_path / "train.h5", broken())

    def test_content_that_was_not_written_can_be_read_back(self, tmp_path, monkeypatch):
        """HDF5 reads what it wrote; a file whose disk is full from the start still behaves like a file."""

        def full(*_: object) -> int:
            raise OSError(28, "No space left on device")

        values = np.random.default_rng(0).random((300, 50))

        def write() -> None:
            with writable_hdf5(tmp_path / "a.h5") as (file, _):
                file.create_dataset("values", data=values, chunks=(7, 50), compression="gzip")
                file.flush()
                np.testing.assert_array_equal(file["values"][()], values)

        monkeypatch.setattr(os, "pwrite", full)
        with pytest.raises(DataError, match="No space left"):
            write()


def test_a_complete_file_is_ordinary_hdf5(tmp_path):
    with writable_hdf5(tmp_path / "a.h5") as (file, check):
        file["values"] = np.arange(5)
        check()
    with open_hdf5(tmp_path / "a.h5") as file:
        check_self_contained(file, tmp_path / "a.h5")
        assert file["values"][()].tolist() == [0, 1, 2, 3, 4]
