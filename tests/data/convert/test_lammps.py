"""LAMMPS's text dumps, by hand and by ase."""

import gzip
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import Options, convert
from nmpm.data.format import Split, read_metadata
from nmpm.data.inspection import inspect
from nmpm.data.sources import FolderSource
from nmpm.errors import DataError

T, N = 6, 5
BOX = ((-1, 3), (0, 2), (-0.5, 0.5))


def frame_text(
    step: int, rows: Sequence[Sequence[object]], columns: str, flags: str = "ff ff pp", extra: str = ""
) -> str:
    box = "".join(f"{low} {high}\n" for low, high in BOX)
    table = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    return (
        f"{extra}ITEM: TIMESTEP\n{step}\nITEM: NUMBER OF ATOMS\n{len(rows)}\nITEM: BOX BOUNDS {flags}\n{box}"
        f"ITEM: ATOMS {columns}\n{table}"
    )


def positions(frames: int = T) -> np.ndarray:
    return np.random.default_rng(0).random((frames, N, 2)).round(4)


def dump(path: Path, frames: int = T, flags: str = "ff ff pp") -> np.ndarray:
    """Frames whose particles are in another order in each; returns positions by id."""
    rng, position = np.random.default_rng(1), positions(frames)
    text = ""
    for t in range(frames):
        rows = [(i + 1, 1 + i % 2, *position[t, i], 0, 10 * i, -t) for i in rng.permutation(N)]
        text += frame_text(100 * t, rows, "id type x y z vx vy", flags)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return position


@pytest.mark.parametrize("name", ["run.lammpstrj", "run.dump.gz", "dump.grains"])
def test_particles_are_sorted_by_id(tmp_path, name):
    position = dump(tmp_path / "data" / name)
    notes = convert(tmp_path / "data", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read_with_fields(0), read_metadata(tmp_path / "out")
    np.testing.assert_array_equal(trajectory.position, position.astype("f4"))
    np.testing.assert_array_equal(trajectory.fields["velocity"][3], [[10 * i, -3] for i in range(N)])
    assert trajectory.particle_type.tolist() == [1, 2, 1, 2, 1]
    assert (metadata.dim, metadata.bounds, metadata.boundary) == (2, BOX[:2], ("wall", "wall"))
    assert any("100 steps of LAMMPS apart" in note and "--dt" in note for note in notes)
    assert any("z is 0 everywhere" in note for note in notes)


@pytest.mark.parametrize("name", ["dump.{}", "dump{}.liggghts", "grains_{}.out", "post/{}.txt.gz", "{}"])
@pytest.mark.parametrize("format_name", [None, "lammps"])
def test_dumps_are_recognised_by_their_content(tmp_path, name, format_name):
    position = positions()
    for t in range(T):
        file = tmp_path / "data" / "run" / name.format(500 * t)
        file.parent.mkdir(parents=True, exist_ok=True)
        text = frame_text(500 * t, [(i, *position[t, i], 0) for i in range(N)], "id x y z").encode()
        file.write_bytes(gzip.compress(text) if file.suffix == ".gz" else text)
    (tmp_path / "data" / "run" / "log.lammps").write_text("LAMMPS\n")
    (tmp_path / "data" / "run" / "in.sim").write_text("units si\n")
    convert(tmp_path / "data", tmp_path / "out", format_name)
    np.testing.assert_array_equal(Split(tmp_path / "out" / "train.h5").read(0).position, position.astype("f4"))


def test_the_format_that_is_named_overrules_names(tmp_path):
    position = dump(tmp_path / "grains.csv")
    convert(tmp_path / "grains.csv", tmp_path / "out", "lammps")
    np.testing.assert_array_equal(Split(tmp_path / "out" / "train.h5").read(0).position, position.astype("f4"))
    with pytest.raises(DataError, match=r"grains.csv: no file \* there"):
        convert(tmp_path / "grains.csv", tmp_path / "other", "ply")


def test_a_file_per_frame(tmp_path):
    position = positions()
    (tmp_path / "run").mkdir()
    for t in range(T):
        rows = [(i, *position[t, i]) for i in range(N)]
        (tmp_path / "run" / f"dump.{500 * t}.lammpstrj").write_text(frame_text(500 * t, rows, "id x y"))
    notes = convert(tmp_path / "run", tmp_path / "out", options=Options(dt=0.1))
    np.testing.assert_array_equal(Split(tmp_path / "out" / "train.h5").read(0).position, position.astype("f4"))
    assert read_metadata(tmp_path / "out").dt == 0.1
    assert not any("LAMMPS apart" in note for note in notes)


@pytest.mark.parametrize(
    ("columns", "row"),
    [
        ("xs ys zs", (0.5, 0.25, 0.5)),
        ("xu yu zu", (5.0, 0.5, 0.0)),
        ("xsu ysu zsu ix iy iz", (1.5, 0.25, 0.5, 1, 0, 0)),
        ("xu x yu y zu z", (-7.0, 1.0, 0.5, 0.5, 0.0, 0.0)),
    ],
    ids=["scaled", "unwrapped", "both", "two kinds"],
)
def test_coordinates_are_those_in_the_box(tmp_path, columns, row):
    rows = [row, row]
    text = "".join(frame_text(t, rows, columns, "pp ss ff") for t in range(2))
    (tmp_path / "run.lammpstrj").write_text(text.replace("0.25", "0.2500001", 1))
    convert(tmp_path / "run.lammpstrj", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read_with_fields(0), read_metadata(tmp_path / "out")
    np.testing.assert_allclose(trajectory.position[1], [[1, 0.5]] * 2 if metadata.dim == 2 else [[1, 0.5, 0]] * 2)
    assert metadata.boundary[:2] == ("periodic", "wall")
    assert set(trajectory.fields) == {"time"}


def test_times_elements_and_further_columns(tmp_path):
    rows = [(1, 2, "Fe", 0.5, 0.5, 7.5, 3), (2, 1, "wall", 0.6, 0.5, 8.5, 4)]
    text = "".join(
        frame_text(t, rows, "id type element x y radius c_stress[1]", extra=f"ITEM: UNITS\nlj\nITEM: TIME\n{0.5 * t}\n")
        for t in (0, 1, 1, 2)  # the simulation went on after timestep 1
    )
    (tmp_path / "run.lammpstrj").write_text(text)
    convert(tmp_path / "run.lammpstrj", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    assert trajectory.fields["time"].tolist() == [0, 0.5, 1]
    assert trajectory.fields["radius"].tolist() == [7.5, 8.5]
    assert trajectory.fields["c_stress[1]"].tolist() == [[3, 4]] * 3
    assert trajectory.particle_type.tolist() == [2, 1]
    assert read_metadata(tmp_path / "out").particle_types == {1: "wall", 2: "Fe"}


def test_a_dump_by_ase(tmp_path):
    ase, io = pytest.importorskip("ase"), pytest.importorskip("ase.io")
    position = np.random.default_rng(0).random((3, 4, 3))
    atoms = [ase.Atoms("ArArNeAr", frame, cell=[2, 2, 2], pbc=[True, False, True]) for frame in position]
    io.write(tmp_path / "run.xyz", atoms, format="extxyz")
    convert(tmp_path / "run.xyz", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read(0), read_metadata(tmp_path / "out")
    np.testing.assert_allclose(trajectory.position, position, rtol=1e-5)
    assert metadata.boundary == ("periodic", "wall", "periodic")
    assert metadata.bounds == ((0, 2), (0, 2), (0, 2))
    assert [metadata.particle_types[i] for i in trajectory.particle_type] == ["Ar", "Ar", "Ne", "Ar"]


GOOD = frame_text(0, [(1, 0.1, 0.2), (2, 0.3, 0.4)], "id x y")


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (GOOD.replace("ff ff pp", "xy xz yz pp pp pp").replace("-1 3", "-1 3 0.5"), "its box is triclinic"),
        (GOOD.replace("2 0.3 0.4\n", ""), "ends at line 21, within a frame; its first 11 lines are complete frames"),
        (GOOD[:-3], "ends at line 22, within a frame; its first 11 lines are complete frames: head -n 11"),
        (GOOD[:70], r"ends at line 17, within a frame; its first 11 lines|line 17 is|expected"),
        (GOOD.replace("0.3", "abc").replace("\n0\n", "\n7\n"), "timestep 7: .*abc"),
        (GOOD.replace("2 0.3", "1 0.3").replace("\n0\n", "\n7\n"), "frame 1: 2 particles have the id 1"),
        (GOOD.replace("0.3", "nan").replace("\n0\n", "\n7\n"), r"frame 1: position of particle 1 is \[nan, 0.4\]"),
        (GOOD.replace("id x y", "id q r").replace("\n0\n", "\n7\n"), "timestep 7: no columns x y, .*found: id q r"),
        (
            GOOD.replace("0.1", "abc").replace("\n0\n", "\n7\n"),
            "timestep 7: the column x must contain numbers, but has 'abc'",
        ),
        (
            GOOD.replace("1 0.1 0.2", "a 0.1 0.2").replace("2 0.3 0.4", "").replace("\n0\n", "\n7\n"),
            "line 22 or before: an empty",
        ),
        (GOOD.replace("ff ff pp", "ff pp"), "line 16 has 2 boundaries, not one for each of three axes"),
        ("something else\n", "line 12 is 'something else'; expected ITEM: TIMESTEP"),
    ],
    ids=[
        "triclinic", "missing", "cut", "header", "text", "twice", "nan", "columns", "no numbers", "empty line", "flags",
        "other",
    ],
)  # fmt: skip
def test_damaged_dumps_are_named(tmp_path, second, message):
    (tmp_path / "run.lammpstrj").write_text(GOOD + second)
    with pytest.raises(DataError, match=f"run.lammpstrj.*{message}"):
        convert(tmp_path / "run.lammpstrj", tmp_path / "out")


def test_a_gzipped_dump_that_is_cut_is_named(tmp_path):
    dump(tmp_path / "run.lammpstrj.gz", 40)
    content = (tmp_path / "run.lammpstrj.gz").read_bytes()
    (tmp_path / "run.lammpstrj.gz").write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"run.lammpstrj.gz: cannot be read as a LAMMPS dump .*Is it complete\?"):
        convert(tmp_path / "run.lammpstrj.gz", tmp_path / "out")


def test_recorded_grains(recorded, tmp_path):
    convert(recorded / "third-party" / "lammps-grains", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "test.h5").read_with_fields(0), read_metadata(tmp_path / "out")
    assert trajectory.position.shape == trajectory.fields["velocity"].shape == (151, 346, 2)
    assert metadata.bounds == ((-30, 30), (-5, 35))
    bed = trajectory.position[:, trajectory.particle_type == 3]
    assert (bed == bed[0]).all()
    assert len(Split(tmp_path / "out" / "train.h5")) == 8


def falling(path: Path, steps: list[int], columns: str) -> None:
    """A cloud that falls, frames at some numbers of steps of 2e-4; z is the time of a frame."""
    start, text = 20 + np.random.default_rng(0).random((40, 2)), ""
    for step in steps:
        time = 2e-4 * step
        position = start - np.array([0, 9.81 / 2 * time**2])
        rows = [(i + 1, 1, *position[i], 0, 0.0, -9.81 * time)[: len(columns.split())] for i in range(40)]
        text += frame_text(step, rows, columns, "ss ss pp")
    path.write_text(text)


@pytest.mark.parametrize(("columns", "dt"), [("id type x y z", 100.0), ("id type x y z vx vy", 0.02)])
def test_steps_are_times_in_units_of_a_step_or_as_long_as_velocities_tell(tmp_path, columns, dt):
    falling(tmp_path / "a.lammpstrj", list(range(0, 3000, 100)), columns)
    convert(tmp_path / "a.lammpstrj", tmp_path / "native")
    metadata, split = read_metadata(tmp_path / "native"), Split(tmp_path / "native" / "train.h5")
    assert metadata.dt == pytest.approx(dt, rel=1e-6)
    np.testing.assert_allclose(split.time(0), dt * np.arange(30), atol=1e-9)
    assert metadata.gravity == pytest.approx((0, -9.81 * (0.02 / dt) ** 2), rel=1e-3)


@pytest.mark.parametrize("columns", ["id type x y z", "id type x y z vx vy"])
def test_uneven_steps_are_found_and_the_printed_command_mends_them(tmp_path, columns):
    falling(tmp_path / "a.lammpstrj", [*range(0, 1000, 100), *range(800, 2000, 100)], columns)
    convert(tmp_path / "a.lammpstrj", tmp_path / "native")
    finding = next(each for each in inspect(FolderSource(tmp_path / "native")).findings if each.severity != "note")
    assert (finding.kind, finding.details) == ("uneven time steps", "frame 10")
    resample = float(re.search(r"--resample (\S+)\.$", finding.sentence)[1])
    convert(tmp_path / "a.lammpstrj", tmp_path / "mended", options=Options(resample=resample))
    assert not [each for each in inspect(FolderSource(tmp_path / "mended")).findings if each.severity != "note"]
