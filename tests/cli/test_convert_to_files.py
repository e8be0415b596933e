"""`nmpm convert` into files for other programs, and back."""

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.convert import convert
from nmpm.data.format import Split, Trajectory, read_metadata, write_split


@pytest.fixture
def dataset(make_dataset):
    return make_dataset(train=((12, 5), (14, 6)), valid=(), test=((12, 7),))


def test_all_trajectories_become_files_by_split(dataset, tmp_path, capsys):
    assert main(["convert", str(dataset), "out.csv"]) == 0
    assert "wrote 3 trajectories to out, a file each" in capsys.readouterr().out
    files = sorted(str(file.relative_to(tmp_path)) for file in (tmp_path / "out").rglob("*.csv"))
    assert files == ["out/test/00000.csv", "out/train/00000.csv", "out/train/00001.csv"]
    assert main(["convert", str(dataset), "out.csv"]) == 1
    assert "out: exists already; 3 trajectories would become files in it" in capsys.readouterr().err


def test_one_trajectory_becomes_a_file(dataset, tmp_path, capsys):
    assert main(["convert", str(dataset), "out.npz", "--trajectory", "1", "--split", "train"]) == 0
    assert "wrote out.npz; to look at it: open out.npz in NumPy" in capsys.readouterr().out
    with np.load("out.npz") as arrays:
        np.testing.assert_array_equal(arrays["position"], Split(dataset / "train.h5").read(1).position)
    assert main(["convert", str(dataset / "test.h5"), "test.npz"]) == 0  # the only one of the file
    with np.load("test.npz") as arrays:
        np.testing.assert_array_equal(arrays["position"], Split(dataset / "test.h5").read(0).position)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.csv", "--trajectory", "1"], "--trajectory 1: the test split has trajectories 0 … 0."),
        (["a.csv", "--split", "valid"], "--split valid: the dataset has train, test."),
    ],
)
def test_what_cannot_be_is_refused(dataset, tmp_path, words, message, capsys):
    assert main(["convert", str(dataset), *words]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / words[0]).exists()


def test_the_source_is_never_replaced(dataset, capsys):
    for source, destination in ((dataset, f"{dataset}.vtp"), (dataset / "test.h5", dataset / "test.h5")):
        assert main(["convert", str(source), str(destination)]) == 1
        assert "would replace" in capsys.readouterr().err


def test_fields_that_a_form_cannot_hold_are_named(dataset, capsys):
    run = Split(dataset / "test.h5").read(0)
    write_split(dataset / "test.h5", [Trajectory(run.position, run.particle_type, {}, {"noise": np.zeros(99)})])
    assert main(["convert", str(dataset), "out.csv", "--split", "test"]) == 0
    assert "- Not numbers of particles, so left out: noise" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".h5", ".vtkhdf", ".npz", ".csv", ".pvd", ".lammpstrj"])
def test_there_and_back_again(dataset, tmp_path, suffix):
    """Positions, types and times survive every form that is read, bit by bit."""
    if suffix == ".pvd":
        pytest.importorskip("pyvista")
    stated = ["--trajectory", "0", "--split", "train"]
    assert main(["convert", str(dataset), f"out{suffix}", *stated]) == 0
    convert(tmp_path / f"out{suffix}", tmp_path / "back")
    split = Split(next((tmp_path / "back").glob("*.h5")))
    before = Split(dataset / "train.h5").read(0)
    np.testing.assert_array_equal(split.read(0).position, before.position)
    assert read_metadata(tmp_path / "back").dt == pytest.approx(read_metadata(dataset).dt, rel=1e-6)
    named = read_metadata(tmp_path / "back").particle_types
    assert len(np.unique(split.read(0).particle_type)) == len(np.unique(before.particle_type))
    if suffix in (".h5", ".vtkhdf", ".npz"):
        types = read_metadata(dataset).particle_types
        assert [named[i] for i in split.read(0).particle_type] == [types[i] for i in before.particle_type]


def test_a_run_that_a_training_would_cut_stays_whole(capsys):
    position = np.random.default_rng(0).random((500, 6, 2), dtype=np.float32)
    np.save("run.npy", position)
    assert main(["convert", "run.npy", "run.npz"]) == 0
    assert "Cut along time" not in capsys.readouterr().out
    with np.load("run.npz") as arrays:
        np.testing.assert_array_equal(arrays["position"], position)
