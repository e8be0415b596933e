"""Folders of runs with a file per frame, and files of many frames; as XYZ, whose frames any test can write."""

import logging
import re
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.format import Split, Trajectory, read_metadata
from nmpm.errors import DataError

T, N = 12, 6


def positions(frames: int = T, seed: int = 0, particles: int = N) -> np.ndarray:
    return np.random.default_rng(seed).random((frames, particles, 3)).round(4)


def frame_text(position: np.ndarray, properties: str = "pos:R:3", comment: str = "", **columns: np.ndarray) -> str:
    table = [position, *(np.asarray(values).reshape(len(position), -1) for values in columns.values())]
    rows = [" ".join(str(value) for part in table for value in part[i]) for i in range(len(position))]
    return "\n".join([str(len(position)), f"Properties={properties} {comment}", *rows]) + "\n"


def write_run(folder: Path, seed: int = 0, numbers: range | list[int] = range(T)) -> np.ndarray:
    folder.mkdir(parents=True)
    position = positions(len(numbers), seed)
    for number, frame in zip(numbers, position, strict=True):
        (folder / f"frame_{number}.xyz").write_text(frame_text(frame))
    return position


def write_frames(path: Path, *frames: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(frames))
    return path


def read(source: Path, out: Path, split: str = "train", index: int = 0) -> Trajectory:
    if not out.exists():
        convert(source, out)
    return Split(out / f"{split}.h5").read_with_fields(index)


@pytest.mark.parametrize("kind", ["a file per frame", "a file per run"])
def test_folders_are_splits_and_runs_in_numeric_order(tmp_path, kind):
    for seed, name in enumerate(["train/run2", "train/run10", "val/run0", "test/deep/er"]):
        if kind == "a file per frame":
            write_run(tmp_path / "data" / name, seed)
        else:
            write_frames(tmp_path / "data" / f"{name}.xyz", *map(frame_text, positions(seed=seed)))
    for seed, (split, index) in enumerate([("train", 0), ("train", 1), ("valid", 0), ("test", 0)]):
        trajectory = read(tmp_path / "data", tmp_path / "out", split, index)
        np.testing.assert_array_equal(trajectory.position, positions(seed=seed).astype("f4"))


def test_runs_without_splits_are_divided(tmp_path):
    for run in range(5):
        write_run(tmp_path / "data" / f"run{run}", run)
    dataset = open_dataset(tmp_path / "data")
    assert dataset.counts == {"train": 3, "valid": 1, "test": 1}
    np.testing.assert_array_equal(next(dataset.splits["test"]()).position, positions(seed=4).astype("f4"))


@pytest.mark.parametrize("kind", ["a file per frame", "a file per run"])
def test_one_long_run_is_cut_along_time(tmp_path, kind):
    if kind == "a file per frame":
        position = write_run(tmp_path / "run", numbers=range(500))
    else:
        position = positions(500)
        write_frames(tmp_path / "run", *map(frame_text, position)).rename(tmp_path / "run.xyz")
    source = tmp_path / ("run" if kind == "a file per frame" else "run.xyz")
    for split, part in (("train", slice(400)), ("valid", slice(400, 450)), ("test", slice(450, None))):
        np.testing.assert_array_equal(read(source, tmp_path / "out", split).position, position[part].astype("f4"))


def test_a_missing_frame_is_empty_where_the_others_are_regular(tmp_path):
    numbers = [n for n in range(0, 40, 2) if n != 8]
    position = write_run(tmp_path / "run", numbers=numbers)
    notes = convert(tmp_path / "run", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read(0)
    assert np.flatnonzero(np.isnan(trajectory.position).all(axis=(1, 2))).tolist() == [4]
    np.testing.assert_array_equal(np.delete(trajectory.position, 4, axis=0), position.astype("f4"))
    assert any("1 of 20 frames are missing (first after frame_6.xyz)" in note for note in notes)


def test_uneven_numbers_are_noted(tmp_path):
    for run in range(3):
        write_run(tmp_path / "data" / f"run{run}", run, [0, 1, 2, 5, 9])
    dataset = open_dataset(tmp_path / "data")
    assert len(next(dataset.splits["train"]()).position) == 5
    notes = [note for note in dataset.notes if "uneven" in note]
    assert len(notes) == 1
    assert "first after frame_2.xyz" in notes[0]
    assert "2 more runs" in notes[0]


def test_particles_are_matched_by_their_ids(tmp_path):
    """They come, go, and are in another order in each frame; those that come are in slots by their ids, too."""
    rng, position = np.random.default_rng(0), positions()
    there = rng.random((T, N)) < 0.6
    there[0, 0], there[:, 1] = False, True
    frames = []
    for t in range(T):
        order = rng.permutation(np.flatnonzero(there[t]))
        frames.append(frame_text(position[t, order], "pos:R:3:track:I:1:heat:R:1", track=order * 7, heat=order + t))
    trajectory = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")
    np.testing.assert_array_equal(np.isnan(trajectory.position[..., 0]), ~there)
    np.testing.assert_array_equal(trajectory.position[there], position[there].astype("f4"))
    heat = np.arange(N) + np.arange(T)[:, None]
    np.testing.assert_array_equal(trajectory.fields["heat"][there], heat[there])


@pytest.mark.parametrize(("name", "absent", "present"), [("type", -1, 4), ("active", 0, 1)])
def test_masks_make_particles_absent(tmp_path, name, absent, present):
    marks = np.full((T, N), present)
    marks[3:5, 2] = absent
    frames = [frame_text(*each, **{name: mark}) for each, mark in
              ((((p, f"pos:R:3:{name}:I:1"), m) for p, m in zip(positions(), marks, strict=True)))]  # fmt: skip
    trajectory = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")
    np.testing.assert_array_equal(np.isnan(trajectory.position).all(axis=2), marks == absent)
    assert trajectory.particle_type.tolist() == [4 if name == "type" else 0] * N


def test_particles_that_are_never_there_are_left_out_with_a_count(tmp_path, caplog):
    types = np.array([5, -1, 5, 6, 6, -1])
    frames = [frame_text(position, "pos:R:3:type:I:1", type=types) for position in positions()]
    with caplog.at_level(logging.WARNING):
        trajectory = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")
    assert trajectory.particle_type.tolist() == [5, 5, 6, 6]
    np.testing.assert_array_equal(trajectory.position, positions()[:, types != -1].astype("f4"))
    assert "2 particles have type -1 in all frames" in caplog.text


def test_vectors_become_velocities_or_fields_per_component(tmp_path):
    position = positions()
    frames = [
        frame_text(p, "pos:R:3:Velocity:R:3:spin:R:3:stress:R:6", v=2 * p, spin=3 * p, stress=np.tile(p, 2))
        for p in position
    ]
    fields = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out").fields
    np.testing.assert_allclose(fields["velocity"], 2 * position, rtol=1e-6)
    np.testing.assert_allclose(fields["spin_y"], 3 * position[..., 1], rtol=1e-6)
    np.testing.assert_allclose(fields["stress_5"], position[..., 2], rtol=1e-6)
    assert len(fields) == 1 + 3 + 6


def test_times_and_an_array_that_some_frames_lack(tmp_path, caplog):
    frames = [frame_text(p, comment=f"Time={0.5 * t}") for t, p in enumerate(positions())]
    frames[:2] = [
        frame_text(p, "pos:R:3:heat:R:1", f"Time={0.5 * t}", h=p[:, :1]) for t, p in enumerate(positions()[:2])
    ]
    with caplog.at_level(logging.WARNING):
        fields = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out").fields
    assert fields["time"].tolist() == (0.5 * np.arange(T)).tolist()
    assert "heat" not in fields
    assert "frame 2: the array 'heat' is not in all frames" in caplog.text


TWO = np.array([[0, 0, 0], [1, 1, 1]])
FIRST = frame_text(TWO)
WITH_IDS = frame_text(TWO, "pos:R:3:id:I:1", id=[1, 2])
FLAT = positions(20) * [1, 1, 0]


def of_types(*types: int) -> str:
    return frame_text(TWO, "pos:R:3:id:I:1:material:I:1", id=[7, 9], material=types)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([FIRST, frame_text(positions(1, particles=3)[0])], "frame 1: 3 particles, but 2 in .*frame 0. .*id array"),
        ([FIRST, frame_text(TWO, "pos:R:3:type:I:1", id=[1, 2])], "frame 1: only some frames have types"),
        ([WITH_IDS, FIRST], "frame 1: only some frames have ids"),
        (
            [of_types(1, 2), of_types(1, 2), of_types(1, 3)],
            "frame 2: particle with id 9 has type 3, but 2 in frames before",
        ),
        (
            [FIRST, frame_text(np.where(TWO, 1, [0, 0, np.inf]))],
            r"frame 1: position of particle 0 is \[0.0, 0.0, inf\]",
        ),
        ([FIRST, frame_text(TWO[:, :2], "pos:R:2")], "frame 1: 2 axes, unlike the first frame"),
        (
            [*map(frame_text, FLAT[:15]), *map(frame_text, positions(5))],
            r"frame 15: z = .*, but 0 for all particles of the first frames",
        ),
        ([FIRST, "2\nsomething\n1 0 0\n"], "ends at line 7, within a frame; its first 4 lines are complete frames"),
        ([FIRST, "many\n"], "line 5 is 'many'; expected the number of particles"),
        (
            [FIRST, "2\nProperties=where:R:3\n0 0 0\n1 1 1\n"],
            "Properties=where:R:3 does not list names, kinds and widths, or",
        ),
        ([FIRST, "2\nProperties=pos:R:3\n0 0 0\n1 1\n"], "frame 1: .*column"),
    ],
    ids=[
        "number", "types", "ids", "a type that changes", "infinite", "axes", "plane", "cut", "no number",
        "no positions", "columns",
    ],
)  # fmt: skip
def test_frames_that_do_not_fit_are_named(tmp_path, frames, message):
    with pytest.raises(DataError, match=f"run.xyz.*{message}"):
        convert(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")


def test_equal_ids_in_the_first_frame_are_no_ids(tmp_path):
    """They are the number of a body, or of a process."""
    frames = [frame_text(p, "pos:R:3:tag:I:1", tag=[1, 1, 1, 2, 2, 2]) for p in positions()]
    trajectory = read(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")
    assert trajectory.fields["tag"][0].tolist() == [1, 1, 1, 2, 2, 2]


def test_texts_that_are_no_types_are_left_out_with_a_note(tmp_path):
    frames = [frame_text(p, "pos:R:3:colour:S:1", colour=["red"] * N) for p in positions()]
    notes = convert(write_frames(tmp_path / "run.xyz", *frames), tmp_path / "out")
    assert any(note.startswith("Left out") and "colour" in note for note in notes)


def test_one_type_with_a_name(tmp_path):
    frames = [frame_text(p, "material:S:1:pos:R:3", p=["honey"] * N) for p in positions()]
    lines = [frame.split("\n", 2) for frame in frames]  # the name is the first column
    texts = [f"{n}\n{keys}\n" + "".join(f"honey {' '.join(row.split()[:3])}\n" for row in rows.splitlines())
             for n, keys, rows in lines]  # fmt: skip
    trajectory = read(write_frames(tmp_path / "run.xyz", *texts), tmp_path / "out")
    assert trajectory.particle_type.tolist() == [0] * N
    assert read_metadata(tmp_path / "out").particle_types == {0: "honey"}


@pytest.mark.parametrize(
    ("files", "change", "message"),
    [
        (
            [f"other_{t}.xyz" for t in range(T)],
            lambda _: frame_text(positions()[0]),
            r"run: files of 2 kinds may be the particles: frame_\*.xyz \(12\), other_\*.xyz \(12\)\. State which:"
            r" --files 'frame_\*.xyz'; kinds .* --files 'frame_\*.xyz,other_\*.xyz', join.* a folder of its own",
        ),
        (
            [*(f"frame_{t}.xyz" for t in range(T)), "mesh_0.xyz"],
            lambda _: "",
            r"run: no file in it has particles: frame_\*.xyz \(no frame\), mesh_\*.xyz \(no frame\)",
        ),
        ([f"frame_{T - 1}.xyz"], lambda _: "", r"frame_11.xyz: there is no frame in it"),
        (["frame_5.xyz"], lambda content: content[:-20], "frame_5.xyz: cannot be read as XYZ"),
        (["frame_5.xyz"], lambda content: 2 * content, "frame_5.xyz: there is more than one frame in it, but one"),
    ],
    ids=["series", "no particles", "empty", "cut", "many"],
)
def test_wrong_files_are_named(tmp_path, files, change, message):
    write_run(tmp_path / "run")
    for file in (tmp_path / "run" / name for name in files):
        file.write_text(change(file.read_text() if file.exists() else ""))
    with pytest.raises(DataError, match=message):
        convert(tmp_path / "run", tmp_path / "out")


@pytest.mark.parametrize(
    ("others", "note"),
    [
        (
            ["mesh_0.xyz", "mesh_1.xyz"],
            r"the particles are frame_\*.xyz; left out: mesh_\*.xyz \(another kind of file\);",
        ),
        (["initial.xyz"], r"left out: initial.xyz \(another kind of file\); others are read by --files"),
        (["log_0.xyz"], r"left out: log_\*.xyz \(cannot be read as XYZ"),
        (["a_log_0.xyz"], r"left out: a_log_\*.xyz \(cannot be read as XYZ"),
    ],
    ids=["name", "one", "content", "first"],
)
def test_files_of_another_kind_beside_the_particles_are_left_out(tmp_path, others, note):
    position = write_run(tmp_path / "run")
    for name in others:
        (tmp_path / "run" / name).write_text("no" if "log" in name else frame_text(positions(particles=2)[0]))
    dataset = open_dataset(tmp_path / "run")
    assert any(re.search(note, line) for line in dataset.notes)
    np.testing.assert_array_equal(next(dataset.splits["train"]()).position, position.astype("f4"))


@pytest.mark.parametrize("bounds", [range(T), [0], [0, 5]], ids=["each", "first", "some"])
def test_boundary_particles_join_as_walls(tmp_path, bounds):
    """In files of their own, of all frames or of those from which on they are so."""
    fluid, wall = positions(), np.repeat(positions(1, seed=1, particles=3), T, axis=0)
    wall[5:] += 1 if len(bounds) == 2 else 0
    (tmp_path / "run").mkdir()
    columns = "pos:R:3:Idp:I:1"
    for t in range(T):
        text = frame_text(fluid[t], f"{columns}:heat:R:1", Idp=np.arange(N), heat=np.full(N, t))
        (tmp_path / "run" / f"PartFluid_{t:04}.xyz").write_text(text)
    for t in bounds:
        (tmp_path / "run" / f"PartBound_{t:04}.xyz").write_text(frame_text(wall[t], columns, Idp=np.arange(3)))
    trajectory = read(tmp_path / "run", tmp_path / "out")
    metadata = read_metadata(tmp_path / "out")
    assert metadata.particle_types == {0: "fluid", 1: "wall"}
    assert metadata.static_types == (frozenset() if len(bounds) == 2 else {1})
    np.testing.assert_array_equal(trajectory.particle_type, [0] * N + [1] * 3)
    np.testing.assert_array_equal(trajectory.position, np.concatenate([fluid, wall], axis=1).astype("f4"))
    assert "heat" not in trajectory.fields


def test_files_that_are_selected_are_read_and_join_as_materials(tmp_path):
    for seed, name in enumerate(["sand", "ice", "log"]):
        write_run(tmp_path / name, seed)
        for file in sorted((tmp_path / name).iterdir()):
            target = tmp_path / "data" / "run" / f"{name}_{file.name}"
            target.parent.mkdir(parents=True, exist_ok=True)
            file.rename(target)
    one = open_dataset(tmp_path / "data", options=Options(files="SAND_*"))
    np.testing.assert_array_equal(next(one.splits["train"]()).position, positions(seed=0).astype("f4"))
    both = open_dataset(tmp_path / "data", options=Options(files="run/sand_*.xyz, ice_*"))
    assert both.metadata.particle_types == {0: "ice", 1: "sand"}
    trajectory = next(both.splits["train"]())
    np.testing.assert_array_equal(np.bincount(trajectory.particle_type), [N, N])
    np.testing.assert_array_equal(trajectory.position[:, trajectory.particle_type == 1], positions(seed=0).astype("f4"))
    with pytest.raises(DataError, match=r"--files snow_\*: no file of these names is of a format that is read"):
        open_dataset(tmp_path / "data", options=Options(files="snow_*"))


def test_folders_of_grids_are_left_out_where_their_files_are_others(tmp_path):
    write_run(tmp_path / "out" / "particles")
    write_run(tmp_path / "out" / "grids", 1)
    assert open_dataset(tmp_path / "out").counts == {"train": 2}
    for file in (tmp_path / "out" / "grids").iterdir():
        file.rename(file.with_stem(file.stem.replace("frame", "grid")))
    dataset = open_dataset(tmp_path / "out")
    assert dataset.counts == {"train": 1}
    assert any("grids: left out by its name" in note for note in dataset.notes)
    np.testing.assert_array_equal(next(dataset.splits["train"]()).position, positions().astype("f4"))


def test_a_folder_of_datasets_is_refused(tmp_path):
    write_run(tmp_path / "all" / "one" / "train" / "run0")
    with pytest.raises(DataError, match=r"all: there are datasets in its folders. Give one of them: .*one\."):
        convert(tmp_path / "all", tmp_path / "out")


def test_one_frame_is_no_run(tmp_path):
    write_run(tmp_path / "run")
    with pytest.raises(DataError, match=r"frame_3.xyz: there is one frame in it. Give the folder of the frames."):
        convert(tmp_path / "run" / "frame_3.xyz", tmp_path / "out")
