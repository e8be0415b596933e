import pickle
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nmpm.data.format import Split, Trajectory, read_metadata, split_paths, write_split
from nmpm.errors import DataError

FINITE = st.floats(-10, 10, width=32)


def runs(count: int = 2, frames: int = 9, particles: int = 6) -> list[Trajectory]:
    rng = np.random.default_rng(count)
    return [
        Trajectory(
            rng.random((frames, particles, 2), dtype=np.float32),
            np.full(particles, 7),
            {"seed": i, "gravity": [0.0, -9.81], "generator": "made up 1.0"},
        )
        for i in range(count)
    ]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_split(tmp_path / "train.h5", runs())
    return tmp_path / "train.h5"


def error_of(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        Split(path).read(0)
    message = str(caught.value)
    assert len(message) < 800
    return message


class TestRoundTrip:
    @given(
        position=arrays.arrays(
            np.float32, arrays.array_shapes(min_dims=3, max_dims=3, min_side=1, max_side=3), elements=FINITE
        ),
        seed=st.integers(0, 2**31),
    )
    @settings(max_examples=25, deadline=None)
    def test_gives_back_what_was_written(self, tmp_path_factory, position, seed):
        path = tmp_path_factory.mktemp("split") / "train.h5"
        types = np.arange(position.shape[1])
        write_split(path, [Trajectory(position, types, {"seed": seed})])
        read = Split(path).read(0)
        np.testing.assert_array_equal(read.position, position)
        np.testing.assert_array_equal(read.particle_type, types)
        assert read.attributes == {"seed": seed}
        assert read.position.dtype == np.float32
        assert read.particle_type.dtype == np.int64

    def test_reads_a_range_of_frames(self, file):
        whole, part = Split(file).read(1), Split(file).read(1, 3, 7)
        np.testing.assert_array_equal(part.position, whole.position[3:7])
        np.testing.assert_array_equal(part.attributes["gravity"], [0.0, -9.81])

    def test_index(self, file):
        split = Split(file)
        assert (len(split), split.names, split.dim) == (2, ("00000", "00001"), 2)
        assert (split.frames(1), split.particles(1)) == (9, 6)
        assert pickle.loads(pickle.dumps(split)).names == split.names  # noqa: S301
        assert split_paths(file.parent) == {"train": file}

    def test_same_trajectories_give_the_same_bytes(self, file):
        before = file.read_bytes()
        time.sleep(1.1)  # a time stamp would have changed by then
        write_split(file, iter(runs()))
        assert file.read_bytes() == before

    def test_interrupted_writing_leaves_the_old_file(self, file):
        before = file.read_bytes()

        def broken():
            yield runs()[0]
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            write_split(file, broken())
        assert file.read_bytes() == before
        assert [path.name for path in file.parent.iterdir()] == ["train.h5"]

    def test_nothing_to_write(self, tmp_path):
        with pytest.raises(DataError, match="no trajectories"):
            write_split(tmp_path / "train.h5", [])
        assert not list(tmp_path.iterdir())


class TestBadFiles:
    def test_missing(self, file):
        message = error_of(file.with_name("valid.h5"))
        assert "valid.h5: no such file" in message
        assert "train.h5" in message

    @given(kept=st.floats(0, 1, exclude_max=True))
    @settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    def test_truncated(self, file, kept):
        content = file.read_bytes()
        cut = file.with_name("cut.h5")
        cut.write_bytes(content[: int(kept * len(content))])
        assert "cut.h5: cannot be read as HDF5" in error_of(cut)

    def test_not_hdf5(self, tmp_path):
        path = tmp_path / "train.h5"
        path.write_text("particles")
        assert "train.h5: cannot be read as HDF5" in error_of(path)

    def test_damaged_inside(self, file):
        content = bytearray(file.read_bytes())
        with h5py.File(file) as opened:
            chunk = opened["00000/position"].id.get_chunk_info(0)
        content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
        file.write_bytes(content)
        assert "cannot be read as HDF5" in error_of(file)

    def test_empty(self, tmp_path):
        h5py.File(tmp_path / "train.h5", "w").close()
        assert "no trajectory" in error_of(tmp_path / "train.h5")

    @pytest.mark.parametrize("key", ["position", "particle_type"])
    def test_missing_key(self, file, key):
        with h5py.File(file, "a") as opened:
            opened["00001"].move(key, "other")
        message = error_of(file)
        assert f"trajectory 00001: the key '{key}' is missing" in message
        assert "other" in message

    def test_an_error_that_is_kept_leaves_hdf5_to_other_threads(self, file):
        """An iteration over h5py's `items()` that an error ends holds HDF5's lock as long as the error's traceback."""
        with h5py.File(file, "a") as opened:
            opened["00000"].move("position", "other")
        with pytest.raises(DataError) as kept:
            Split(file)
        thread = threading.Thread(target=lambda: h5py.File(file).close(), daemon=True)
        thread.start()
        thread.join(20)
        assert not thread.is_alive(), f"HDF5 is locked while {kept.value!r} is kept"

    def test_not_a_group(self, file):
        with h5py.File(file, "a") as opened:
            opened["position"] = np.zeros((3, 2, 2))
        assert "'position' is not a group" in error_of(file)

    @pytest.mark.parametrize(
        ("key", "value", "named"),
        [
            ("position", np.zeros((9, 6, 2), int), "int64 of shape (9, 6, 2)"),
            ("position", np.zeros((9, 12), np.float32), "float32 of shape (9, 12)"),
            ("position", np.zeros((0, 6, 2), np.float32), "shape (0, 6, 2)"),
            ("position", np.zeros((9, 6, 4), np.float32), "4 dimensions"),
            ("position", np.zeros((9, 5, 2), np.float32), "position has 5 particles but particle_type has 6"),
            ("particle_type", np.zeros(6, np.float32), "particle_type should be integers"),
            ("particle_type", np.zeros((6, 1), int), "shape (6, 1)"),
        ],
    )
    def test_wrong_array(self, file, key, value, named):
        with h5py.File(file, "a") as opened:
            del opened["00001"][key]
            opened["00001"][key] = value
        message = error_of(file)
        assert "trajectory 00001" in message
        assert named in message

    def test_dimensions_differ(self, tmp_path):
        flat = runs(1)[0]
        deep = Trajectory(np.zeros((2, 3, 3), np.float32), np.zeros(3, int))
        write_split(tmp_path / "train.h5", [flat, deep])
        assert "trajectory 00001: 3 dimensions, 2 in the others" in error_of(tmp_path / "train.h5")

    @given(
        frame=st.integers(0, 8), particle=st.integers(0, 5), bad=st.sampled_from([np.nan, np.inf, -np.inf]), start=...
    )
    @settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    def test_not_finite(self, file, frame: int, particle: int, bad: float, start: bool):
        write_split(file, runs())
        with h5py.File(file, "a") as opened:
            opened["00000/position"][frame, particle, 1] = bad
        with pytest.raises(DataError, match=f"trajectory 00000: position of particle {particle} in frame {frame} is"):
            Split(file).read(0, frame if start else 0)
        Split(file).read(1)

    def test_non_finite_positions_cannot_be_written(self):
        position = np.zeros((3, 2, 2))
        position[2, 1, 0] = np.nan
        with pytest.raises(DataError, match="particle 1 in frame 2"):
            Trajectory(position, np.zeros(2, int))


class TestRecorded:
    @pytest.mark.parametrize(
        ("name", "family", "trajectories"),
        [
            ("deepmind-waterdrop", "deepmind", 9),
            ("jaxsph-heated-channel-2d", "lagrangebench", 39),
            ("lagrangebench-3d-lj", "lagrangebench", 1),
        ],
    )
    def test_reads(self, recorded, name, family, trajectories):
        metadata = read_metadata(recorded / name, family)
        split = Split(recorded / name / "train.h5")
        assert len(split) == trajectories
        assert split.dim == metadata.dim
        trajectory = split.read(0, stop=5)
        assert trajectory.position.shape == (5, split.particles(0), metadata.dim)
        metadata.check_types(trajectory.particle_type, split.where(0))
