"""VTKHDF files that vtk writes, and those of this project."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import convert
from nmpm.data.format import Split, Trajectory, read_metadata
from nmpm.data.write.vtk import write_viewable
from nmpm.errors import DataError

T, N = 4, 6


def positions(dim: int = 3) -> np.ndarray:
    return np.random.default_rng(0).random((T, N, dim)).astype("f4")


def write_by_vtk(data: object, path: Path) -> None:
    pytest.importorskip("pyvista", reason="the extra `vtk` is not installed")
    from vtkmodules.vtkIOHDF import vtkHDFWriter

    writer = vtkHDFWriter()
    writer.SetInputData(data)
    writer.SetFileName(str(path))
    writer.Write()


@pytest.mark.parametrize("kind", ["PolyData", "UnstructuredGrid"])
def test_a_file_per_frame(tmp_path, kind):
    pyvista = pytest.importorskip("pyvista", reason="the extra `vtk` is not installed")
    (tmp_path / "run").mkdir()
    for t, frame in enumerate(positions()):
        points = pyvista.PolyData(frame)
        points["velocity"], points["material"] = 3 * frame, np.arange(N) % 2
        points.field_data["TimeValue"] = [0.1 * t]
        write_by_vtk(points if kind == "PolyData" else points.cast_to_unstructured_grid(), tmp_path / f"run/{t}.vtkhdf")
    convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, positions())
    np.testing.assert_array_equal(trajectory.fields["velocity"], 3 * positions())
    assert trajectory.particle_type.tolist() == [0, 1] * (N // 2)
    assert trajectory.fields["time"] == pytest.approx([0, 0.1, 0.2, 0.3])


def own_file(path: Path, dim: int = 2) -> Trajectory:
    """Two dimensions, a particle that is absent for a while, a number per particle."""
    position = positions(dim)
    position[1:3, 2] = np.nan
    fields = {"velocity": 2 * positions(dim), "mass": np.arange(N) + 0.5, "time": 0.25 * np.arange(T)}
    trajectory = Trajectory(position, np.arange(N) % 3, {}, fields)
    write_viewable(path, [trajectory])
    return trajectory


def test_time_steps_in_a_file_that_this_project_writes(tmp_path):
    written = own_file(tmp_path / "run.vtkhdf")
    convert(tmp_path / "run.vtkhdf", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, written.position)
    np.testing.assert_array_equal(trajectory.fields["mass"], written.fields["mass"])
    there = ~np.isnan(written.position)
    np.testing.assert_array_equal(trajectory.fields["velocity"][there], written.fields["velocity"][there])
    assert trajectory.particle_type.tolist() == written.particle_type.tolist()
    assert read_metadata(tmp_path / "out").dt == 0.25


def link_elsewhere(file: h5py.File) -> None:
    file["VTKHDF/more"] = h5py.ExternalLink("other.h5", "/")


def declare_more_points(file: h5py.File) -> None:
    file["VTKHDF/NumberOfPoints"][-1] = 10 * N


def change_type(file: h5py.File) -> None:
    file["VTKHDF"].attrs["Type"] = np.bytes_(b"ImageData")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (link_elsewhere, "'VTKHDF/more' is an external link to 'other.h5'"),
        (declare_more_points, f"{10 * N} rows of Points from {(T - 1) * N} on are not there"),
        (change_type, "it has a ImageData; particles are points, as PolyData or UnstructuredGrid"),
        (lambda file: file.__delitem__("VTKHDF"), "there is no group VTKHDF in it"),
        (lambda file: file.__delitem__("VTKHDF/Points"), "cannot be read as HDF5"),
    ],
    ids=["link", "points", "type", "group", "missing"],
)
def test_wrong_files_are_named(tmp_path, damage, message):
    own_file(tmp_path / "run.vtkhdf", 3)
    with h5py.File(tmp_path / "run.vtkhdf", "a") as file:
        damage(file)
    with pytest.raises(DataError, match=f"run.vtkhdf: {message}"):
        convert(tmp_path / "run.vtkhdf", tmp_path / "out")
