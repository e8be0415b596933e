import pickle
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nmpm.data.array_checks import check_end
from nmpm.data.format import Split, Trajectory, read_metadata, split_paths, write_split
from nmpm.errors import DataError

SHAPES = arrays.array_shapes(min_dims=3, max_dims=3, min_side=1, max_side=3)


def runs() -> list[Trajectory]:
    rng = np.random.default_rng(0)
    return [
        Trajectory(rng.random((9, 6, 2), np.float32), np.full(6, 7), {"seed": i, "gravity": [0.0, -9.81]})
        for i in range(2)
    ]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_split(tmp_path / "train.h5", runs())
    return tmp_path / "train.h5"


@given(position=arrays.arrays(np.float32, SHAPES, elements=st.floats(-10, 10, width=32)), seed=st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_what_was_written_is_read_again(tmp_path_factory, position, seed):
    path = tmp_path_factory.mktemp("split") / "train.h5"
    types = np.arange(position.shape[1])
    write_split(path, [Trajectory(position, types, {"seed": seed}, {"heat": position[..., 0]})])
    read = Split(path).read_with_fields(0)
    np.testing.assert_array_equal(read.position, position)
    np.testing.assert_array_equal(read.particle_type, types)
    np.testing.assert_array_equal(read.fields["heat"], position[..., 0])
    assert read.attributes == {"seed": seed}
    assert (read.position.dtype, read.particle_type.dtype) == (np.float32, np.int64)


def test_frames_and_sizes_are_read(file):
    split = Split(file)
    whole, part = split.read(1), split.read(1, 3, 7)
    np.testing.assert_array_equal(part.position, whole.position[3:7])
    np.testing.assert_array_equal(part.attributes["gravity"], [0.0, -9.81])
    assert (len(split), split.names, split.dim) == (2, ("00000", "00001"), 2)
    assert (split.frames(1), split.particles(1)) == (9, 6)
    assert pickle.loads(pickle.dumps(split)).names == split.names  # noqa: S301
    assert split_paths(file.parent) == {"train": file}


def test_the_layout_is_lagrangebenchs(file):
    """As LagrangeBench documents it: a group per trajectory, `position` (T, N, D), `particle_type` (N,)."""
    with h5py.File(file) as opened:
        assert list(opened) == ["00000", "00001"]
        for group in opened.values():
            assert (group["position"].shape, group["position"].dtype) == ((9, 6, 2), np.float32)
            assert group["particle_type"].shape == (6,)
            assert np.issubdtype(group["particle_type"].dtype, np.integer)


def test_same_trajectories_give_the_same_bytes_and_interrupted_writing_leaves_the_old_file(file):
    before = file.read_bytes()
    time.sleep(1.1)  # a time stamp would have changed by then
    write_split(file, iter(runs()))
    assert file.read_bytes() == before

    def broken():
        yield runs()[1]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_split(file, broken())
    with pytest.raises(DataError, match="no trajectories"):
        write_split(file, [])
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == ["train.h5"]


def test_files_that_are_no_split_are_named(file):
    def refused(message: str, path: Path = file) -> None:
        with pytest.raises(DataError, match=message):
            Split(path)

    refused(r"test\.h5: no such file \(beside it: train\.h5\)", file.with_name("test.h5"))
    whole = file.read_bytes()
    for content in (b"nothing", whole[: len(whole) // 2]):
        file.write_bytes(content)
        refused("train.h5: cannot be read as HDF5")
    h5py.File(file, "w").close()
    refused("no trajectory")
    with h5py.File(file, "a") as opened:
        opened["position"] = np.zeros((3, 2, 2))
    refused("'position' is not a group")


def test_missing_keys_are_named_and_hdf5_is_free_for_other_threads(file):
    """An iteration over h5py's `items()` that an error ends holds HDF5's lock as long as the error's traceback."""
    with h5py.File(file, "a") as opened:
        opened["00000"].move("position", "other")
    with pytest.raises(DataError, match=r"trajectory 00000: the key 'position' is missing \(found: other") as kept:
        Split(file)
    thread = threading.Thread(target=lambda: h5py.File(file).close(), daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive(), f"HDF5 is locked while {kept.value!r} is kept"


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("position", np.zeros((9, 6, 2), int), r"int64 of shape \(9, 6, 2\)"),
        ("position", np.zeros((9, 12), np.float32), r"float32 of shape \(9, 12\)"),
        ("position", np.zeros((0, 6, 2), np.float32), r"shape \(0, 6, 2\)"),
        ("position", np.zeros((9, 6, 4), np.float32), "4 dimensions"),
        ("position", np.zeros((9, 5, 2), np.float32), "position has 5 particles but particle_type has 6"),
        ("position", np.zeros((9, 6, 3), np.float32), "3 dimensions, 2 in the others"),
        ("particle_type", np.zeros(6, np.float32), "particle_type should be integers"),
    ],
    ids=["integers", "axes", "empty", "dim", "count", "others", "types"],
)
def test_wrong_arrays_are_named(file, key, value, named):
    with h5py.File(file, "a") as opened:
        del opened["00001"][key]
        opened["00001"][key] = value
    with pytest.raises(DataError, match=f"trajectory 00001.*{named}"):
        Split(file)


@pytest.mark.parametrize(("bad", "start"), [(np.nan, 0), (np.inf, 5)])
def test_positions_that_are_not_finite_are_named(file, bad, start):
    with h5py.File(file, "a") as opened:
        opened["00000/position"][5, 4, 1] = bad
    with pytest.raises(DataError, match="trajectory 00000: position of particle 4 in frame 5 is"):
        Split(file).read(0, start)
    position = Split(file).read(1).position
    position[2, 1, 0] = bad
    with pytest.raises(DataError, match="particle 1 in frame 2"):
        Trajectory(position, np.zeros(6, int))


def test_absent_particles_are_nan_in_all_coordinates(tmp_path):
    position = np.ones((6, 3, 2), np.float32)
    position[:2, 0] = np.nan
    position[3] = np.nan  # a missing frame
    write_split(tmp_path / "train.h5", [Trajectory(position, np.zeros(3, int))])
    np.testing.assert_array_equal(Split(tmp_path / "train.h5").read(0).position, position)


@pytest.mark.parametrize(
    ("last", "message"), [(3, r"NaN from frame 4 on.*diverged.*position\[:4\]"), (-1, "no particle is there")]
)
def test_a_trajectory_that_ends_without_particles_has_diverged(file, last, message):
    with h5py.File(file, "a") as opened:
        opened["00000/position"][last + 1 :] = np.nan
    position = Split(file).read(0).position
    with pytest.raises(DataError, match=f"run 1: .*{message}"):
        check_end(position, "run 1")


def test_particles_that_leave_one_by_one_have_not_diverged():
    position = np.ones((8, 5, 2), np.float32)
    for particle in range(5):
        position[particle + 2 :, particle] = np.nan
    check_end(position, "run 1")


def test_recorded_lennard_jones(recorded):
    folder = recorded / "lagrangebench-3d-lj"
    metadata, split = read_metadata(folder, "deepmind"), Split(folder / "train.h5")
    assert len(split) == 1
    assert split.read(0, stop=5).position.shape == (5, split.particles(0), metadata.dim)
