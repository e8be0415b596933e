import time

import numpy as np
import pytest

from nmpm.data.format import Split, Trajectory
from nmpm.data.write.vtk import write_viewable

TYPES = np.array([7, 7, 7, 3])


def run(frames=5, dim=2, seed=0, **fields):
    position = np.random.default_rng(seed).random((frames, 4, dim), dtype=np.float32)
    return Trajectory(position, TYPES, {"scene": '{"dt": 0.5}'}, fields)


def read(path):
    """Each step as VTK reads it: time, and a data object."""
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        yield reader.GetTimeValue(), reader.GetOutputDataObject(0)


def arrays(poly):
    from vtk.util.numpy_support import vtk_to_numpy

    data = poly.GetPointData()
    fields = {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)).copy() for i in range(data.GetNumberOfArrays())}
    return vtk_to_numpy(poly.GetPoints().GetData()).copy(), fields


@pytest.mark.parametrize("dim", [2, 3])
def test_vtk_reads_every_frame_exactly(tmp_path, dim):
    velocity, density = np.ones((5, 4, dim), np.float32), np.arange(20, dtype=np.float32).reshape(5, 4)
    trajectory = run(dim=dim, velocity=velocity, density=density, mass=np.arange(4.0))
    trajectory.position[2:, 1] = np.nan
    write_viewable(tmp_path / "out.h5", [trajectory])
    steps = list(read(tmp_path / "out.h5"))
    assert [moment for moment, _ in steps] == [0, 0.5, 1, 1.5, 2]
    for frame, (_, poly) in enumerate(read(tmp_path / "out.h5")):
        points, fields = arrays(poly)
        np.testing.assert_array_equal(points[:, :dim], trajectory.position[frame])
        assert not points[:, dim:].any()
        assert poly.GetNumberOfVerts() == 4
        assert sorted(fields) == ["density", "mass", "particle_type", "velocity"]
        np.testing.assert_array_equal(fields["density"], density[frame])
        np.testing.assert_array_equal(fields["mass"], np.arange(4))
        np.testing.assert_array_equal(fields["particle_type"], TYPES)
        assert fields["velocity"].tolist() == [[1, 1, 1 if dim == 3 else 0]] * 4


def test_several_trajectories_and_truths_are_blocks(tmp_path):
    density = np.arange(20, dtype=np.float32).reshape(5, 4)
    one, other = run(5, truth=run(5, seed=1).position, density=density), run(4, seed=2, time=np.arange(4) * 9.0)
    write_viewable(tmp_path / "out.h5", [one, other])
    steps = [step for _, step in read(tmp_path / "out.h5")]
    names = [steps[0].GetMetaData(i).Get(steps[0].NAME()) for i in range(3)]
    assert names == ["prediction_00000", "truth_00000", "trajectory_00001"]
    for frame, step in enumerate(read(tmp_path / "out.h5")):
        points = [arrays(step[1].GetBlock(block))[0][:, :2] for block in range(3)]
        np.testing.assert_array_equal(points[0], one.position[frame])
        np.testing.assert_array_equal(points[1], one.fields["truth"][frame])
        np.testing.assert_array_equal(points[2], other.position[min(frame, 3)])
    fields = [sorted(arrays(steps[0].GetBlock(block))[1]) for block in range(3)]
    assert fields == [["density", "particle_type"], ["particle_type"], ["particle_type"]]


def test_the_file_is_still_native_and_determined_by_its_content(tmp_path):
    trajectories = [run(seed=1), run(seed=2)]
    write_viewable(tmp_path / "a.h5", trajectories)
    time.sleep(1.1)  # a time stamp would have changed by then
    write_viewable(tmp_path / "b.h5", trajectories)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    split = Split(tmp_path / "a.h5")
    assert split.names == ("00000", "00001")
    np.testing.assert_array_equal(split.read_with_fields(1).position, trajectories[1].position)


def test_nothing_is_copied(tmp_path):
    position = np.random.default_rng(0).random((100, 1000, 3), dtype=np.float32)
    write_viewable(tmp_path / "out.h5", [Trajectory(position, np.zeros(1000, np.int64))])
    assert (tmp_path / "out.h5").stat().st_size < 1.04 * position.nbytes
