"""Files are read back by the programs' own libraries."""

import csv
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import convert, open_dataset
from nmpm.data.format import Metadata, Split, Trajectory, read_metadata
from nmpm.data.write import WRITERS, find_writer
from nmpm.data.write.base import Clip
from nmpm.data.write.vtk import write_viewable
from nmpm.errors import ConfigError
from nmpm.viz.files import read_labelled

FRAMES, DT = 6, 0.25
TYPES = np.array([5, 3, 5, 5])
METADATA = Metadata(
    bounds=((0, 1), (0, 2)), dt=DT, dim=2, sequence_length=FRAMES - 1, particle_types={5: "fresh water", 3: "wall"},
    static_types=frozenset({3}), gravity=(0, -9.81), particle_volume=0.01, boundary=("periodic", "wall"),
)  # fmt: skip


def made(absent=False):
    """Three drops that move right, by 0.2 a frame in a box of one; one wall particle."""
    start = np.array([[0.1, 0.2], [0.5, 0.0], [0.3, 1.25], [1 / 3, 0.5]])
    position = np.repeat(start[None], FRAMES, axis=0)
    position[..., 0] += 0.2 * np.arange(FRAMES)[:, None] * (TYPES == 5)
    position[..., 0] %= 1
    truth = position[:-1] + 0.125
    if absent:
        position[:3, 3] = np.nan
    heat = np.arange(FRAMES * 4, dtype=np.float32).reshape(FRAMES, 4)
    fields = {"heat": heat, "share": np.arange(4.0), "truth": truth.astype(np.float32), "misfit": np.zeros(99)}
    return Trajectory(position, TYPES, {}, fields)


def write(path: Path, trajectory: Trajectory, metadata: Metadata = METADATA) -> Path:
    return find_writer("--out", path).write(path, Clip(trajectory, metadata))


def there(trajectory, frame):
    """(n, 2) positions of the particles that are there, and their indices."""
    (index,) = np.nonzero(~np.isnan(trajectory.position[frame, :, 0]))
    return trajectory.position[frame, index], index


@pytest.fixture(params=[False, True], ids=["all there", "absent"])
def trajectory(request):
    return made(request.param)


def test_vtk_reads_series(tmp_path, trajectory):
    pyvista = pytest.importorskip("pyvista")
    reader = pyvista.get_reader(write(tmp_path / "out.vtp", trajectory))
    assert reader.path == str(tmp_path / "out.pvd")
    assert reader.time_values == [DT * frame for frame in range(FRAMES)]
    for frame in range(FRAMES):
        reader.set_active_time_point(frame)
        mesh, (position, index) = reader.read()[0], there(trajectory, frame)
        np.testing.assert_array_equal(mesh.points, np.pad(position, ((0, 0), (0, 1))))
        assert mesh.n_verts == len(index)
        np.testing.assert_array_equal(mesh["id"], index)
        np.testing.assert_array_equal(mesh["particle_type"], TYPES[index])
        np.testing.assert_array_equal(mesh["heat"], trajectory.fields["heat"][frame, index])
        np.testing.assert_allclose(mesh["velocity"][:, 0], 0.2 / DT * (TYPES[index] == 5), atol=1e-6)
        if frame < FRAMES - 1:
            np.testing.assert_array_equal(mesh["truth"][:, :2], trajectory.fields["truth"][frame, index])


def test_usd_reads_points_by_material(tmp_path, trajectory):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    stage = usd.Stage.Open(str(write(tmp_path / "out.usda", trajectory)))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (4, 0, FRAMES - 1)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    prims = {prim.GetName(): UsdGeom.Points(prim) for prim in stage.GetDefaultPrim().GetChildren()}
    assert list(prims) == ["wall", "fresh_water", "truth_fresh_water"]
    assert prims["wall"].GetPointsAttr().GetNumTimeSamples() == 1
    water = prims["fresh_water"]
    assert list(water.GetWidthsAttr().Get()) == pytest.approx([0.1])
    assert len(water.GetDisplayColorAttr().Get()) == 1
    for frame in range(FRAMES):
        position, index = there(trajectory, frame)
        water_of = TYPES[index] == 5
        points = np.array(water.GetPointsAttr().Get(frame))
        np.testing.assert_array_equal(points, np.pad(position[water_of], ((0, 0), (0, 1))))
        assert list(water.GetIdsAttr().Get(frame)) == index[water_of].tolist()
        assert np.array(water.GetVelocitiesAttr().Get(frame))[:, 0] == pytest.approx(0.2 / DT)
        heat = water.GetPrim().GetAttribute("primvars:heat").Get(frame)
        assert list(heat) == trajectory.fields["heat"][frame, index[water_of]].tolist()
    position, index = there(trajectory, 2)
    truth = np.array(prims["truth_fresh_water"].GetPointsAttr().Get(2))
    np.testing.assert_array_equal(truth[:, :2], trajectory.fields["truth"][2, index[TYPES[index] == 5]])


def test_ase_reads_lammps_dumps(tmp_path, trajectory):
    io = pytest.importorskip("ase.io")
    images = io.read(write(tmp_path / "out.lammpstrj", trajectory), index=":", format="lammps-dump-text")
    assert len(images) == FRAMES
    for frame, image in enumerate(images):
        position, index = there(trajectory, frame)
        np.testing.assert_allclose(image.positions[:, :2], position, rtol=0, atol=1e-7)
        assert image.numbers.tolist() == TYPES[index].tolist()
        assert image.pbc.tolist() == [True, False, True]


def test_numpy_reads_archives(tmp_path, trajectory):
    with np.load(write(tmp_path / "out.npz", trajectory), allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["position"], trajectory.position)
        np.testing.assert_array_equal(arrays["particle_type"], TYPES)
        np.testing.assert_array_equal(arrays["time"], DT * np.arange(FRAMES))
        np.testing.assert_array_equal(arrays["misfit"], np.zeros(99))
        assert {i: name for i, name in enumerate(arrays["type_names"]) if name} == METADATA.particle_types


def test_csv_reads_rows(tmp_path, trajectory):
    with write(tmp_path / "out.csv", trajectory).open() as file:
        table = list(csv.DictReader(file))
    assert list(table[0])[:6] == ["frame", "time", "id", "type", "x", "y"]
    for frame in range(FRAMES):
        part, (position, index) = [row for row in table if int(row["frame"]) == frame], there(trajectory, frame)
        assert [int(row["id"]) for row in part] == index.tolist()
        assert [int(row["type"]) for row in part] == TYPES[index].tolist()
        np.testing.assert_array_equal(np.float32([[row["x"], row["y"]] for row in part]), position)
        assert [float(row["share"]) for row in part] == index.tolist()


@pytest.mark.parametrize("suffix", [".h5", ".vtkhdf"])
def test_native_files_bring_their_scene_along(tmp_path, suffix, trajectory):
    split = Split(write(tmp_path / f"out{suffix}", trajectory))
    np.testing.assert_array_equal(split.read(0).position, trajectory.position)
    assert ("velocity" in split.fields(0)) == (suffix == ".vtkhdf")
    if not np.isnan(trajectory.position).any():
        shown = read_labelled(split)
        assert (list(shown.positions), shown.dt, shown.materials) == (["recorded"], DT, ("fresh water",))


@pytest.mark.parametrize("suffix", sorted({*WRITERS} - {".usda"}))
@settings(max_examples=6, deadline=None)
@given(dt=st.floats(1e-6, 1e4), dim=st.sampled_from([2, 3]))
def test_what_is_read_back_has_the_same_time_step(suffix, dt, dim):
    """Though velocities that nobody recorded are differences of positions, and gravity accelerates."""
    if suffix in (".vtp", ".pvd"):
        pytest.importorskip("pyvista")
    frames = np.arange(20)[:, None, None]
    fall = np.random.default_rng(0).uniform(4, 5, (1, 30, dim)) + 0.01 * frames - 0.002 * frames**2
    metadata = Metadata(((0, 6),) * dim, dt, dim, 19, {0: "sand"})
    with TemporaryDirectory() as folder:
        written = write(Path(folder) / f"out{suffix}", Trajectory(fall.astype(np.float32), np.zeros(30, int)), metadata)
        convert(written, Path(folder) / "again")
        assert read_metadata(Path(folder) / "again").dt == pytest.approx(dt, rel=1e-8)


def test_fields_that_frames_cannot_have_are_named():
    labelled = replace(made(), fields={"id": np.array([b"a", b"b", b"c", b"d"])})
    for suffix, left_out in ((".vtp", [{"misfit"}, {"id"}]), (".csv", [{"misfit"}, set()]), (".npz", [set(), set()])):
        writer = find_writer("--out", Path(f"out{suffix}"))
        assert [writer.left_out(made()), writer.left_out(labelled)] == left_out


@pytest.mark.parametrize("suffix", [".csv", ".lammpstrj", ".vtp", ".vtkhdf", ".npz", ".h5"])
@pytest.mark.parametrize("shared", [False, True])
def test_particles_keep_their_ids_and_types(tmp_path, suffix, shared):
    """By which positions are joined, also of particles that come late or share a column."""
    if suffix == ".vtp":
        pytest.importorskip("pyvista")
    ids, run = np.tile([41, 7, 30, 12], (FRAMES, 1)), made(absent=True)
    if shared:
        run.position[2] = np.nan
        run.position[2, 0] = 0.5
        ids[3:, 1:] += 100
    stored = {"track": np.where(np.isnan(run.position[..., 0]), -1, ids)} if shared else {"id": ids[0]}
    file = write(tmp_path / f"out{suffix}", replace(run, fields=stored))
    back = next(iter(open_dataset(file).splits.values()))
    (read,) = back()
    for frame in range(FRAMES):
        here, there = (np.flatnonzero(~np.isnan(one.position[frame, :, 0])) for one in (read, run))
        here, there = here[np.argsort(read.ids()[frame, here])], there[np.argsort(ids[frame, there])]
        assert read.ids()[frame, here].tolist() == ids[frame, there].tolist()
        assert read.particle_type[here].tolist() == TYPES[there].tolist()
        np.testing.assert_array_equal(read.position[frame, here], run.position[frame, there])


def test_csv_has_the_names_of_types_and_ids_that_are_texts(tmp_path):
    labels = np.char.encode(np.array(["a", 'b "2", left', "ä", "d"]), "utf-8")
    with write(tmp_path / "out.csv", replace(made(), fields={"id": labels})).open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))[:4]
    assert [row["id"] for row in table] == ["a", 'b "2", left', "ä", "d"]
    assert [row["material"] for row in table] == [METADATA.particle_types[number] for number in TYPES.tolist()]


@pytest.mark.parametrize("suffix", WRITERS)
def test_writing_again_gives_the_same_bytes_and_leaves_nothing_beside(tmp_path, suffix):
    """And replaces what was there."""
    path, contents = tmp_path / f"out{suffix}", []
    for _ in range(2):
        write(path, made())
        contents.append({file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()})
        time.sleep(1.1 if suffix in (".h5", ".npz") else 0)
    assert contents[0] == contents[1]
    assert {file.name for file in tmp_path.iterdir()} in ({path.name}, {"out", "out.pvd"})


def test_what_cannot_be_written_is_refused_first(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/thesis.tex").touch()
    for name, message in (
        ("out.xyz", r"--out .*out.xyz: nothing is written by that suffix; there are .h5, .vtkhdf, .vtp, .usda"),
        ("out", "nothing is written by that suffix"),
        ("out.vtp", "its frames would replace .*out, which is not such a series"),
        ("missing/out.csv", "does not exist; create it first"),
    ):
        with pytest.raises(ConfigError, match=message):
            find_writer("--out", tmp_path / name)


KINDS = np.array([7, 7, 7, 3])


def described(frames=5, dim=2, seed=0, **fields):
    position = np.random.default_rng(seed).random((frames, 4, dim), dtype=np.float32)
    return Trajectory(position, KINDS, {"scene": '{"dt": 0.5}'}, fields)


def read_vtkhdf(path):
    """Each step as VTK reads it: time, and a data object."""
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        yield reader.GetTimeValue(), reader.GetOutputDataObject(0)


def arrays_of(poly):
    from vtk.util.numpy_support import vtk_to_numpy

    data = poly.GetPointData()
    fields = {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)).copy() for i in range(data.GetNumberOfArrays())}
    return vtk_to_numpy(poly.GetPoints().GetData()).copy(), fields


@pytest.mark.parametrize("dim", [2, 3])
def test_vtk_reads_every_frame_exactly(tmp_path, dim):
    velocity, density = np.ones((5, 4, dim), np.float32), np.arange(20, dtype=np.float32).reshape(5, 4)
    trajectory = described(dim=dim, velocity=velocity, density=density, mass=np.arange(4.0))
    trajectory.position[2:, 1] = np.nan
    write_viewable(tmp_path / "out.h5", [trajectory])
    steps = list(read_vtkhdf(tmp_path / "out.h5"))
    assert [moment for moment, _ in steps] == [0, 0.5, 1, 1.5, 2]
    for frame, (_, poly) in enumerate(read_vtkhdf(tmp_path / "out.h5")):
        points, fields = arrays_of(poly)
        np.testing.assert_array_equal(points[:, :dim], trajectory.position[frame])
        assert not points[:, dim:].any()
        assert poly.GetNumberOfVerts() == 4
        assert sorted(fields) == ["density", "mass", "particle_type", "velocity"]
        np.testing.assert_array_equal(fields["density"], density[frame])
        np.testing.assert_array_equal(fields["mass"], np.arange(4))
        np.testing.assert_array_equal(fields["particle_type"], KINDS)
        assert fields["velocity"].tolist() == [[1, 1, 1 if dim == 3 else 0]] * 4


def test_several_trajectories_and_truths_are_blocks(tmp_path):
    density = np.arange(20, dtype=np.float32).reshape(5, 4)
    one, other = (
        described(5, truth=described(5, seed=1).position, density=density),
        described(4, seed=2, time=np.arange(4) * 9.0),
    )
    write_viewable(tmp_path / "out.h5", [one, other])
    steps = [step for _, step in read_vtkhdf(tmp_path / "out.h5")]
    names = [steps[0].GetMetaData(i).Get(steps[0].NAME()) for i in range(3)]
    assert names == ["prediction_00000", "truth_00000", "trajectory_00001"]
    for frame, step in enumerate(read_vtkhdf(tmp_path / "out.h5")):
        points = [arrays_of(step[1].GetBlock(block))[0][:, :2] for block in range(3)]
        np.testing.assert_array_equal(points[0], one.position[frame])
        np.testing.assert_array_equal(points[1], one.fields["truth"][frame])
        np.testing.assert_array_equal(points[2], other.position[min(frame, 3)])
    fields = [sorted(arrays_of(steps[0].GetBlock(block))[1]) for block in range(3)]
    assert fields == [["density", "particle_type"], ["particle_type"], ["particle_type"]]


def test_the_file_is_still_native_and_determined_by_its_content(tmp_path):
    trajectories = [described(seed=1), described(seed=2)]
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
