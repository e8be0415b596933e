"""HDF5 of many frames: H5MD, as the programs that write it lay it out; VTKHDF that vtk and this project write."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Split, Trajectory, read_metadata
from nmpm.data.write.vtk import write_viewable
from nmpm.errors import DataError

T, N = 8, 5
RUN = np.random.default_rng(0).random((T, N, 3))
STEPS = 50 * np.arange(T)


def write(path: Path, groups: dict[str, dict[str, Any]], boundary: str = "none", edges: Any = (1.0, 1.0, 1.0)) -> Path:
    """Elements whose values are pairs have these steps; times are hundredths of steps."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.create_group("h5md").attrs["version"] = (1, 1)
        for name, elements in groups.items():
            group = file.create_group(f"particles/{name}")
            box = group.create_group("box")
            box.attrs.update({"dimension": 3, "boundary": np.array([boundary] * 3, "S8")})
            box["edges"] = edges
            for element, values in elements.items():
                if not isinstance(values, tuple):
                    group[element] = values
                    continue
                group[f"{element}/value"], group[f"{element}/step"] = values
                group[f"{element}/time"] = np.asarray(values[1]) / 100
    return path


def test_positions_velocities_ids_species_and_times(tmp_path):
    order = np.array([np.random.default_rng(t).permutation(N) for t in range(T)])
    rows = np.take_along_axis(RUN, order[..., None], axis=1)
    content = {
        "position": (rows, STEPS),
        "velocity": (rows[::2], STEPS[::2]),
        "id": (order, STEPS),
        "species": (order % 2, STEPS),
        "image": (np.zeros((T, N, 3), int), STEPS),
        "mass": np.ones(N),
    }
    for seed in range(3):
        write(tmp_path / "data" / f"run{seed}.h5", {"all": content})
    dataset = open_dataset(tmp_path / "data")
    assert dataset.counts == {"train": 1, "valid": 1, "test": 1}
    convert(tmp_path / "data", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read_with_fields(0), read_metadata(tmp_path / "out")
    np.testing.assert_array_equal(trajectory.position, RUN.astype("f4"))
    np.testing.assert_array_equal(trajectory.particle_type, np.arange(N) % 2)
    np.testing.assert_allclose(trajectory.fields["time"], STEPS / 100)
    assert metadata.dt == pytest.approx(0.5)
    assert "velocity" not in trajectory.fields  # which not all frames have


@pytest.mark.parametrize("low", [0, -1])
@pytest.mark.parametrize("cube", [2.0, (2.0, 2.0, 2.0), 2 * np.eye(3)])
def test_periodic_boxes_are_stated(tmp_path, low, cube):
    position = RUN * 2 + low
    outside = position + 2 * np.random.default_rng(1).integers(0, 2, (T, N, 3)) * (np.arange(T) > 0)[:, None, None]
    write(tmp_path / "run.h5md", {"all": {"position": (outside, STEPS)}}, "periodic", cube)
    convert(tmp_path / "run.h5md", tmp_path / "out")
    metadata = read_metadata(tmp_path / "out")
    assert metadata.boundary == ("periodic",) * 3
    assert metadata.bounds == ((low, low + 2),) * 3
    found = Split(tmp_path / "out" / "train.h5").read(0).position
    np.testing.assert_allclose(found, position, atol=1e-5)


def test_even_steps_are_two_numbers(tmp_path):
    path = write(tmp_path / "run.h5", {"all": {"position": (RUN, STEPS)}})
    with h5py.File(path, "a") as file:
        group = file["particles/all/position"]
        for name, (first, step) in {"step": (100, 50), "time": (1.0, 0.5)}.items():
            del group[name]
            group[name] = step
            group[name].attrs["offset"] = first
    convert(path, tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_allclose(trajectory.fields["time"], 1 + 0.5 * np.arange(T))


def test_groups_are_materials_of_their_own_species(tmp_path):
    kinds = h5py.enum_dtype({"grain": 4, "drop": 7})
    wall = RUN[:1, :2].repeat(T, axis=0)
    write(
        tmp_path / "run.h5",
        {"fluid": {"position": (RUN, STEPS)}, "wall": {"position": (wall, STEPS), "species": np.array([4, 7], kinds)}},
    )
    convert(tmp_path / "run.h5", tmp_path / "groups")
    assert read_metadata(tmp_path / "groups").particle_types == {0: "fluid", 1: "wall"}
    position = Split(tmp_path / "groups" / "train.h5").read(0).position
    np.testing.assert_array_equal(position, np.concatenate([RUN, wall], axis=1).astype("f4"))
    content = {"position": (RUN, STEPS), "species": np.array([4, 7, 4, 4, 7], kinds)}
    write(tmp_path / "all.h5", {"all": content, "fluid": {"position": (RUN[:, :2], STEPS)}})
    convert(tmp_path / "all.h5", tmp_path / "out")
    assert read_metadata(tmp_path / "out").particle_types == {0: "drop", 1: "grain"}
    assert Split(tmp_path / "out" / "train.h5").read(0).particle_type.tolist() == [1, 0, 1, 1, 0]


@pytest.mark.parametrize(
    ("position", "edges", "message"),
    [
        (RUN, np.eye(3) + 0.1, "all/box: it is not rectangular"),
        (RUN[..., 0], (1, 1, 1), r"all/position/value: its shape is \(8, 5\), not frames"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, position, edges, message):
    write(tmp_path / "run.h5", {"all": {"position": (position, STEPS)}}, "periodic", edges)
    with pytest.raises(DataError, match=message):
        convert(tmp_path / "run.h5", tmp_path / "out", "h5md")


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
    for t, frame in enumerate(RUN.astype("f4")):
        points = pyvista.PolyData(frame)
        points["velocity"], points["material"] = 3 * frame, np.arange(N) % 2
        points.field_data["TimeValue"] = [0.1 * t]
        write_by_vtk(points if kind == "PolyData" else points.cast_to_unstructured_grid(), tmp_path / f"run/{t}.vtkhdf")
    convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, RUN.astype("f4"))
    np.testing.assert_array_equal(trajectory.fields["velocity"], 3 * RUN.astype("f4"))
    assert trajectory.particle_type.tolist() == (np.arange(N) % 2).tolist()
    assert trajectory.fields["time"] == pytest.approx(0.1 * np.arange(T))


def own_file(path: Path, dim: int = 2) -> Trajectory:
    """A particle that is absent for a while, a number per particle."""
    position = RUN[..., :dim].astype("f4")
    position[1:3, 2] = np.nan
    fields = {"velocity": 2 * RUN[..., :dim].astype("f4"), "mass": np.arange(N) + 0.5, "time": 0.25 * np.arange(T)}
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
