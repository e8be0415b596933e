"""Folders as programs of the field leave them: each is read, or refused with a way that works."""

import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.convert import open_dataset
from nmpm.data.format import Trajectory
from nmpm.errors import DataError
from tests.data.convert.test_array_files import RUN, N, T, components
from tests.data.convert.test_array_files import h5part as steps_of_h5part
from tests.data.convert.writers import write_lammps

WALL = np.random.default_rng(1).random((4, 3)).round(5)
Writer = Callable[[Path], None]


def text(folder: Path, name: str, frame: Callable[[int], str]) -> None:
    for t in range(T):
        file = folder / name.format(t)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(frame(t))


def lines(values: np.ndarray, separator: str = " ", end: str = "") -> str:
    return "".join(separator.join(map(str, row)) + f"{end}\n" for row in values.tolist())


def vtk(folder: Path, name: str, position: np.ndarray, frames: range = range(T), faces: bool = False) -> None:
    for t in frames:
        points = position[t] if position.ndim == 3 else position
        file = folder / name.format(t)
        file.parent.mkdir(parents=True, exist_ok=True)
        cells = (
            "POLYGONS 1 4\n3 0 1 2\n"
            if faces
            else f"VERTICES {len(points)} {2 * len(points)}\n" + "".join(f"1 {index}\n" for index in range(len(points)))
        )
        head = "# vtk DataFile Version 3.0\nparticles\nASCII\nDATASET POLYDATA\n"
        file.write_text(f"{head}POINTS {len(points)} double\n{lines(points)}{cells}")


def splishsplash(folder: Path) -> None:
    vtk(folder, "vtk/ParticleData_Fluid_{}.vtk", RUN)
    vtk(folder, "vtk/rb_data_0_{}.vtk", WALL, range(1), faces=True)


def dualsphysics(folder: Path) -> None:
    vtk(folder, "particles/PartFluid_{:04}.vtk", RUN)
    vtk(folder, "particles/PartBound_{:04}.vtk", WALL)


def dualsphysics_csv(folder: Path) -> None:
    head = "RunName;TimeStep;Np\nCase;0.1;6\n\nPos.x [m];Pos.y [m];Pos.z [m];Idp\n"
    rows = np.concatenate([RUN, np.broadcast_to(np.arange(N)[:, None], (T, N, 1))], axis=2)
    text(folder, "PartFluid_{:04}.csv", lambda t: head + lines(rows[t], ";"))


def yade(folder: Path) -> None:
    vtk(folder, "p1-spheres.{:06}.vtk", RUN)
    vtk(folder, "p1-facets.{:06}.vtk", WALL, faces=True)
    vtk(folder, "p1-intrs.{:06}.vtk", WALL)


def liggghts(folder: Path) -> None:
    vtk(folder, "post/dump{}.vtk", RUN)
    box = "# vtk DataFile Version 3.0\nbox\nASCII\nDATASET RECTILINEAR_GRID\nDIMENSIONS 2 2 2\n"
    axes = "".join(f"{axis}_COORDINATES 2 float\n0 1\n" for axis in "XYZ")
    text(folder, "post/dump{}_boundingBox.vtk", lambda _: box + axes)


def lammps(name: str) -> Writer:
    def write(folder: Path) -> None:
        for t in range(T):
            file = folder / name.format(t)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_lammps(file, RUN[t : t + 1], {"id": np.arange(N)})

    return write


def tecplot(folder: Path) -> None:
    head = 'TITLE = "Shake the Box"\nVARIABLES = "x [mm]", "y [mm]", "z [mm]", "trackID"\n'
    rows = np.concatenate([RUN, np.broadcast_to(np.arange(N)[:, None], (T, N, 1))], axis=2)
    zones = (f'ZONE T="Snapshot {t:04}"\nSTRANDID=1, SOLUTIONTIME={t / 100}\n{lines(rows[t])}' for t in range(T))
    folder.mkdir()
    (folder / "tracks.dat").write_text(head + "".join(zones))


def geotaichi(folder: Path) -> None:
    for name, values in (("particles/MPMParticle", RUN), ("grids/MPMGrid", np.zeros((T, 8, 3)))):
        (folder / name).parent.mkdir(parents=True)
        for t in range(T):
            np.savez(folder / f"{name}{t:06}.npz", position=values[t], t_current=0.01 * t)


def pysph(folder: Path) -> None:
    folder.mkdir()
    for t in range(T):
        components(folder, t)


def edem(folder: Path) -> None:
    folder.mkdir()
    for t in range(T):
        with h5py.File(folder / f"{t}.h5", "w") as file:
            file["TimestepData/0.01/ParticleTypes/0/position"] = RUN[t]
            file["TimestepData/0.01/ParticleTypes/0/ids"] = np.arange(N)


def swift(folder: Path) -> None:
    folder.mkdir()
    for t in range(T):
        with h5py.File(folder / f"snap_{t:04}.hdf5", "w") as file:
            file.create_group("Header").attrs.update({"Time": [0.01 * t], "NumPart_ThisFile": [N, 0, 0, 0, 0, 0]})
            file["PartType0/Coordinates"], file["PartType0/ParticleIDs"] = RUN[t], np.arange(N)


def h5part(folder: Path) -> None:
    folder.mkdir()
    steps_of_h5part(folder / "run.h5")


def h5md(folder: Path) -> None:
    folder.mkdir()
    with h5py.File(folder / "run.h5", "w") as file:
        for name in ("position", "velocity"):
            file[f"particles/all/{name}/value"], file[f"particles/all/{name}/step"] = RUN, np.arange(T)


def paraview(folder: Path) -> None:
    vtk(folder, "fluid_1/fluid_{}.vtk", RUN)
    vtk(folder, "boundary_1/boundary_{}.vtk", WALL)
    for name in ("fluid_1", "boundary_1"):
        sets = "".join(f'<DataSet timestep="{t}" file="{name}/{name[:-2]}_{t}.vtk"/>' for t in range(T))
        (folder / f"{name}.pvd").write_text(f'<VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>')


@pytest.mark.parametrize(
    ("write", "needs_vtk"),
    [
        (splishsplash, True), (dualsphysics, True), (yade, True), (liggghts, True), (paraview, True),
        (dualsphysics_csv, False), (lammps("dump.{}"), False), (lammps("dump{}.liggghts"), False), (tecplot, False),
        (geotaichi, False), (pysph, False), (edem, False), (swift, False), (h5part, False), (h5md, False),
    ],
    ids=lambda value: getattr(value, "__name__", "").replace("write", "lammps"),
)  # fmt: skip
def test_what_programs_write_is_read(tmp_path: Path, write: Writer, needs_vtk: bool) -> None:
    if needs_vtk:
        pytest.importorskip("vtkmodules")
    write(tmp_path / "run")
    dataset = open_dataset(tmp_path / "run")
    assert dataset.counts == {"train": 1}
    trajectory: Trajectory = next(dataset.splits["train"]())
    np.testing.assert_array_equal(trajectory.position[:, :N], RUN.astype("f4"))
    assert trajectory.position.shape[1] == N + (len(WALL) if write is dualsphysics else 0)


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("out/partio/ParticleData_Fluid_1.bgeo", "enableVTKExport"),
        (
            "CaseDam_out/data/Part_0001.bi4",
            r"PartVTK -dirdata data -savevtk particles/PartFluid -onlytype:-all,\+fluid",
        ),
        ("res/ptv_is.10001", "flowtracks"),
        ("case/0.1/lagrangian/cloud/positions", "foamToVTK"),
        ("hopper.data", "data2pvd"),
        ("blendcache_scene/p_000001_00.bphys", r"np\.save"),
        ("job.odb", "odbAccess"),
        ("out/all_0001.pvtu", "ParaView.*Save Data as"),
        ("out/case.xdmf", "ParaView.*Save Data as"),
        ("run.lammpsbin", "binary2txt"),
        ("scan_0.pcd", "CloudCompare"),
        ("results.d3plot", r"export \.csv"),
        ("run.h5.gz", r"gunzip -k \S*run\.h5\.gz && nmpm inspect \S*data"),
        ("unknown.xyzzy", "write_trajectories"),
    ],
)
def test_what_is_not_read_comes_with_a_way(tmp_path: Path, name: str, way: str) -> None:
    path = tmp_path / "data" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"\x00\x01 not read\n")
    for target in (path, tmp_path / "data"):
        with pytest.raises(DataError, match=way) as raised:
            open_dataset(target)
        assert "\n" not in str(raised.value)


def test_objects_of_pysph_come_with_a_way(tmp_path: Path) -> None:
    for t in range(T):
        objects = {name: np.array({"t": t}, dtype=object) for name in ("particles", "solver_data")}
        np.savez(tmp_path / f"dam_{t}.npz", version=np.array(2), **objects)
    with pytest.raises(DataError, match=r"PySPH's \.npz holds Python objects.*dump\(file\.replace"):
        open_dataset(tmp_path)


@pytest.mark.parametrize("suffix", ["zip", "tar.gz", "tgz", "tar"])
@pytest.mark.parametrize("of_folder", [False, True])
def test_archives_are_refused_with_the_commands_that_read_them(tmp_path: Path, suffix: str, of_folder: bool) -> None:
    folder, archive = tmp_path / "made", tmp_path / "my data" / f"run.{suffix}"
    archive.parent.mkdir()
    lammps("dump.{}")(folder)
    if suffix == "zip":
        with zipfile.ZipFile(archive, "w") as content:
            for file in folder.iterdir():
                content.write(file, f"run/{file.name}")
    else:
        with tarfile.open(archive, "w" if suffix == "tar" else "w:gz") as packed:
            packed.add(folder, "run")
    with pytest.raises(DataError, match="archives are not unpacked: ") as raised:
        open_dataset(archive.parent if of_folder else archive)
    match = re.search(r"unpacked: (.*) && nmpm inspect '(.*?)'", str(raised.value))
    assert match is not None
    command = match[1].replace("python ", f"{sys.executable} ", 1)
    subprocess.run(command, shell=True, check=True)  # noqa: S602 (the command is under test)
    np.testing.assert_array_equal(next(open_dataset(Path(match[2])).splits["train"]()).position, RUN.astype("f4"))


NATIVE = {
    "dualsphysics_vtk": "vtkmodules", "geotaichi_npz": "", "h5_group_per_frame": "", "h5md": "", "hoomd_gsd": "gsd",
    "lammps_dump_names": "", "lig_bbox": "vtkmodules", "npy_per_frame": "", "pysph_hdf5": "",
    "splish_native": "vtkmodules", "yade_vtu_with_facets": "vtkmodules",
}  # fmt: skip
"""Samples, with the package that reads them."""


@pytest.mark.slow
@pytest.mark.usefixtures("home")
@pytest.mark.parametrize("name", NATIVE)
def test_samples_are_inspected_converted_and_configured(
    tmp_path: Path, name: str, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = recorded / "third-party" / "native-forms" / name
    pytest.importorskip(NATIVE[name] or "numpy")
    assert main(["inspect", str(source), "--no-picture"]) == 0
    assert main(["convert", str(source), str(tmp_path / "out")]) == 0
    assert main(["init", str(source), "--out", str(tmp_path / "new.yaml")]) == 0
    assert "wrote" in capsys.readouterr().out


@pytest.mark.parametrize("name", NATIVE)
def test_samples_are_read(name: str, recorded: Path) -> None:
    source = recorded / "third-party" / "native-forms" / name
    pytest.importorskip(NATIVE[name] or "numpy")
    trajectory = next(open_dataset(source).splits["train"]())
    particles = 323 if name == "splish_native" else 60
    frames = {"lammps_dump_names": 5, "lig_bbox": 4, "splish_native": 6}.get(name, 30)
    assert trajectory.position.shape == (frames, particles, 2 if name == "splish_native" else 3)
    assert np.isfinite(trajectory.position).all()
