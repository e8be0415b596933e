"""What is said of data of no known form."""

import re
import shutil

import h5py
import numpy as np
import pytest
import scipy.io

import nmpm
from nmpm.data.convert import native_folder, open_dataset
from nmpm.data.convert.nearest import HINTS
from nmpm.errors import DataError

RUN = np.random.default_rng(0).random((3, 30, 20, 2), dtype=np.float32)


def refuse(path, message):
    with pytest.raises(DataError, match=message) as raised:
        open_dataset(path)
    assert "\n" not in str(raised.value)
    assert "docs/howto/your_data.md" in str(raised.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"pos": np.moveaxis(RUN, -1, 2)},
            r"'pos' is float32 of shape \(3, 30, 2, 20\).*\(R, T, D, N\): np\.transpose\(pos, \(0, 1, 3, 2\)\)",
        ),
        ({"positions": RUN[0, 0]}, r"'positions' is .*this is one frame.*np\.stack\(frames\)"),
        ({"a": RUN, "b": RUN}, r"which array are the positions\? Call it position \(a float32 .*, b float32"),
        ({"state": np.zeros((30, 20, 6))}, r"'state' is float64 of shape \(30, 20, 6\); positions are"),
    ],
    ids=["axes", "frame", "several", "state"],
)
def test_arrays_of_another_shape_are_named(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    refuse(tmp_path / "a.npz", message)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.update({f"group/{name}": array for name, array in arrays.items()})
    refuse(tmp_path / "a.h5", "group/")


def test_objects_tables_and_damage_are_named(tmp_path):
    np.savez(tmp_path / "a.npz", runs=np.array([RUN[0], RUN[0, 1:]], dtype=object))
    refuse(tmp_path / "a.npz", r"'runs' holds Python objects, which are not unpickled")
    (tmp_path / "a.npz").write_bytes(b"PK no")
    refuse(tmp_path / "a.npz", r"a\.npz: cannot be read as \.npz")
    (tmp_path / "a.txt").write_text("frame x y\n1 0 0\n")
    refuse(tmp_path / "a.txt", r"a\.txt: it is no table of tracks: no column id \(columns: frame, x, y\)")


@pytest.mark.parametrize("suffix", HINTS)
def test_other_programs_files_come_with_a_way_out(tmp_path, suffix):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / f"run0{suffix}").write_bytes(b"?")
    if suffix != ".pkl":  # which has a format of its own
        refuse(tmp_path, rf"run0{suffix}: {suffix} files are not read: .*{HINTS[suffix].split()[0]}")


@pytest.mark.usefixtures("home")
def test_files_that_are_called_like_splits_need_not_be_native(tmp_path):
    for split in ("train", "valid"):
        with h5py.File(tmp_path / f"{split}.h5", "w") as file:
            file["positions"] = RUN
    folder = native_folder(tmp_path)
    assert sorted(path.name for path in folder.glob("*.h5")) == ["train.h5", "valid.h5"]


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".vtk", ".xyz", ".lammpstrj", ".h5"])
def test_an_empty_file_is_called_empty(tmp_path, suffix):
    (tmp_path / f"run{suffix}").touch()
    with pytest.raises(DataError, match=rf"run{suffix}: the file is empty\."):
        open_dataset(tmp_path / f"run{suffix}")


@pytest.mark.usefixtures("home")
def test_trajectories_of_a_frame_each_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", positions=RUN[:, :1])
    with pytest.raises(DataError, match="its trajectories have one frame each"):
        native_folder(tmp_path / "a.npz")


def test_the_datasets_in_a_folder_are_named(tmp_path):
    for name in ("sand", "water"):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "run.npz", positions=RUN)
    (tmp_path / "notes").mkdir()
    with pytest.raises(DataError, match=r"holds several datasets, sand, water: name one of them, e\.g\. .*/sand\.$"):
        open_dataset(tmp_path)
    shutil.rmtree(tmp_path / "sand")
    with pytest.raises(DataError, match=r"is not one dataset but holds a dataset, water: .*/water\.$"):
        open_dataset(tmp_path)


def test_folders_with_splits_of_their_own_are_not_runs_of_one_dataset(tmp_path):
    for part in ("sand/train", "sand/test", "water/train", "water/test"):
        (tmp_path / part).mkdir(parents=True)
        (tmp_path / part / "run.xyz").write_text("2\n\nA 0 0 0\nA 1 1 0\n" * 3)
    assert set(open_dataset(tmp_path / "sand").splits) == {"train", "test"}
    with pytest.raises(DataError, match="holds several datasets, sand, water: "):
        open_dataset(tmp_path)


@pytest.mark.parametrize("axes", ["DNT", "NDT", "TDN", "TND", "DNTR", "NDTR", "RTDN"])
@pytest.mark.parametrize("kind", ["npz", "h5", "mat", "memory"])
@pytest.mark.parametrize("dim", [2, 3])
def test_axes_in_another_order_come_with_their_transposition(tmp_path, axes, kind, dim):
    """MATLAB's order among them; whether particles start at random or on a lattice."""
    rng = np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * dim, indexing="ij"), -1).reshape(-1, dim)
    start = np.stack([lattice, rng.uniform(0, 4, lattice.shape), lattice + 0.5, lattice])
    runs = start[:, None] + np.cumsum(rng.normal(0, 0.01, (4, 30, len(lattice), dim)), axis=1)
    right = runs if "R" in axes else runs[0]
    names = "RTND" if "R" in axes else "TND"
    stored = np.transpose(right, [names.index(axis) for axis in axes])
    if kind == "memory":
        if axes == "TND":
            return
        with pytest.raises(DataError) as caught:
            nmpm.write_trajectories(tmp_path / "out", [stored], dt=1.0)
    else:
        path = tmp_path / f"a.{kind}"
        if kind == "npz":
            np.savez(path, pos=stored)
        elif kind == "mat":
            scipy.io.savemat(path, {"pos": stored})
        else:
            with h5py.File(path, "w") as file:
                file["pos"] = stored
        if axes == "TND":
            np.testing.assert_allclose(next(open_dataset(path).splits["train"]()).position, right, rtol=1e-6)
            return
        with pytest.raises(DataError) as caught:
            open_dataset(path)
        assert kind != "mat" or re.search(r"permute\(pos, \[[\d, ]+\]\)", str(caught.value))
    order = re.search(r"np\.transpose\((?:pos|…), \(([\d, ]+)\)\)", str(caught.value))[1]
    np.testing.assert_array_equal(np.transpose(stored, [int(axis) for axis in order.split(", ")]), right)
