"""Arrays under usual names, as people save them: runs in a file, also MATLAB's, and a file or a group per frame."""

from collections.abc import Callable, Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from nmpm.data.convert import Options, convert, open_dataset
from nmpm.data.format import Split, read_metadata
from nmpm.data.inspection import inspect
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError, DataError

FRAMES, PARTICLES = 12, 5


def made(seed: int = 0, runs: tuple[int, ...] = (), frames: int = FRAMES, particles: int = PARTICLES, dim: int = 2):
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=1e-3, size=(*runs, frames, particles, dim))
    return (rng.uniform(0.2, 0.8, (*runs, 1, particles, dim)) + np.cumsum(steps, axis=-3)).astype(np.float32)


def read(path: Path, split: str = "train", index: int = 0):
    return next(run for number, run in enumerate(open_dataset(path).splits[split]()) if number == index)


def splits(path: Path) -> dict[str, int]:
    return {name: sum(1 for _ in start()) for name, start in open_dataset(path).splits.items()}


def test_runs_stacked_in_an_npz_are_split_and_converted(tmp_path):
    position, types = made(runs=(8,)), np.array([0, 0, 1, 1, 2])
    rng = np.random.default_rng(1)
    heat, fields = rng.random((8, FRAMES, PARTICLES)), {"stiffness": rng.random((8, PARTICLES)), "mass": rng.random(8)}
    facts = {"dt": 0.004, "gravity": [0.0, -30.0], "odd": np.zeros(77)}
    velocity = np.gradient(position, axis=1)
    np.savez_compressed(
        tmp_path / "mpm.npz", positions=position, types=types, Velocities=velocity, heat=heat, **fields, **facts
    )
    notes = convert(tmp_path / "mpm.npz", tmp_path / "out")
    assert any("Left out" in note and "odd float64 (77,)" in note for note in notes)
    assert any("6 train, 1 valid, 1 test" in note for note in notes)
    last = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    np.testing.assert_array_equal(last.position, position[7])
    np.testing.assert_array_equal(last.particle_type, types)
    np.testing.assert_array_equal(last.attributes["gravity"], [0.0, -30.0])
    assert {name: values.shape for name, values in last.fields.items()} == {
        "heat": (FRAMES, PARTICLES), "stiffness": (PARTICLES,), "mass": (), "velocity": (FRAMES, PARTICLES, 2)
    }  # fmt: skip
    np.testing.assert_array_equal(last.fields["heat"], heat[7])
    metadata = read_metadata(tmp_path / "out")
    assert (metadata.dt, metadata.dim, sorted(metadata.particle_types)) == (0.004, 2, [0, 1, 2])


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.h5", "a.hdf5", "folder"])
def test_files_of_every_kind_hold_one_run(tmp_path, name):
    path, position, types = tmp_path / name, made(), np.arange(PARTICLES) % 2
    match path.suffix:
        case ".npz":
            np.savez(path, pos=position, material=types)
        case ".npy":
            np.save(path, position)
            types = types * 0
        case "":
            path.mkdir()
            np.save(path / "Positions.npy", position)
            np.save(path / "particle_types.npy", types)
        case _:
            with h5py.File(path, "w") as file:
                file["coordinates"], file["phase"] = position, types
    run = read(path)
    np.testing.assert_array_equal(run.position, position)
    np.testing.assert_array_equal(run.particle_type, types)


def test_runs_have_groups_or_numbers(tmp_path):
    runs = [made(seed) for seed in range(11)]
    types = np.array([3, 3, 3, 4, 4])
    np.savez(tmp_path / "numbered.npz", types=types, **{f"run{i}": run for i, run in enumerate(runs)})
    np.savez(tmp_path / "named.npz", **{f"x_{i}": run for i, run in enumerate(runs)},
             **{f"types_{i}": types for i in range(11)})  # fmt: skip
    np.savez(tmp_path / "unnamed.npz", *runs)
    with h5py.File(tmp_path / "groups.h5", "w") as file:
        file["type"] = types
        file.attrs["dt"] = 0.02
        for index, run in enumerate(runs):
            file[f"experiment {index:02d}/data/pos"] = run
    for name in ("numbered.npz", "named.npz", "unnamed.npz", "groups.h5"):
        path = tmp_path / name
        assert splits(path) == {"train": 9, "valid": 1, "test": 1}
        np.testing.assert_array_equal(read(path, "test").position, runs[10])
        np.testing.assert_array_equal(read(path).particle_type, types * (name != "unnamed.npz"))
    assert open_dataset(tmp_path / "groups.h5").metadata.dt == 0.02


def test_files_without_positions_among_others_are_named(tmp_path):
    for index in range(3):
        np.save(tmp_path / f"{index}.npy", made())
    np.savez(tmp_path / "stats.npz", mean=np.zeros(4))
    with pytest.raises(DataError, match=r"stats\.npz: no array can be positions \(mean float64 \(4,\)\)"):
        open_dataset(tmp_path, "arrays")


def test_names_and_folders_divide_runs(tmp_path):
    np.savez(tmp_path / "parts.npz", train=made(runs=(3,)), val=made(runs=(2,)))
    assert splits(tmp_path / "parts.npz") == {"train": 3, "valid": 2}
    for name, count in {"train": 2, "val": 1, "test": 1}.items():
        (tmp_path / "many" / name).mkdir(parents=True)
        for index in range(count):
            np.savez(tmp_path / "many" / name / f"{index}.npz", position=made(index))
    assert splits(tmp_path / "many") == {"train": 2, "valid": 1, "test": 1}
    for index in range(5):
        (tmp_path / "runs" / f"run{index}").mkdir(parents=True)
        np.save(tmp_path / "runs" / f"run{index}" / "position.npy", made(index))
        np.save(tmp_path / "runs" / f"run{index}" / "time.npy", np.arange(FRAMES) * 0.5)
    assert splits(tmp_path / "runs") == {"train": 3, "valid": 1, "test": 1}
    assert read(tmp_path / "runs").fields["time"].dtype == np.float64


def test_one_long_run_is_cut_along_time(tmp_path):
    position = made(frames=600)
    np.savez(tmp_path / "long.npz", position=position, time=np.arange(600) * 0.1)
    run = read(tmp_path / "long.npz", "valid")
    np.testing.assert_array_equal(run.position, position[480:540])
    np.testing.assert_allclose(run.fields["time"], np.arange(480, 540) * 0.1)
    np.savez(tmp_path / "short.npz", position=position[:150])
    assert splits(tmp_path / "short.npz") == {"train": 1}


def test_absent_particles_become_nan(tmp_path):
    position = made()
    changing = np.tile([1, 1, 1, 2, 2], (FRAMES, 1))
    changing[:4, 0] = changing[8:, 3] = -1
    np.savez(tmp_path / "types.npz", position=position, types=changing)
    np.savez(tmp_path / "mask.npz", position=position, active=changing >= 0, types=[1, 1, 1, 2, 2])
    for name in ("types.npz", "mask.npz"):
        run = read(tmp_path / name)
        np.testing.assert_array_equal(np.isnan(run.position).all(axis=2), changing == -1)
        assert run.particle_type.tolist() == [1, 1, 1, 2, 2]
    changing[5, 2] = 2
    np.savez(tmp_path / "types.npz", position=position, types=changing)
    with pytest.raises(DataError, match=r"types\.npz: the type of particle 2 changes, to 2 in frame 5"):
        read(tmp_path / "types.npz")
    padded = np.array([1, 1, -1, 2, 2])
    np.savez(tmp_path / "padded.npz", position=position, types=padded, heat=np.arange(5.0))
    run = read(tmp_path / "padded.npz")
    np.testing.assert_array_equal(run.position, position[:, padded >= 0])
    assert run.fields["heat"].tolist() == [0, 1, 3, 4]


def test_flat_data_become_two_dimensional(tmp_path):
    position = made(runs=(4,), dim=3)
    position[..., 2] = 0
    velocity = position * 2
    np.savez(tmp_path / "flat.npz", position=position, velocity=velocity, gravity=[0.0, -9.81, 0.0])
    dataset, run = open_dataset(tmp_path / "flat.npz"), read(tmp_path / "flat.npz")
    assert dataset.metadata.dim == 2
    assert any("2-D" in note for note in dataset.notes)
    assert (run.position.shape[2], run.fields["velocity"].shape[2], len(run.attributes["gravity"])) == (2, 2, 2)
    position[3, 5, 1, 2] = 0.1
    np.savez(tmp_path / "bumpy.npz", position=position)
    with pytest.raises(DataError, match=r"bumpy.npz, run 3: z is 0 in the first run, but not here"):
        convert(tmp_path / "bumpy.npz", tmp_path / "out")


def test_components_and_names_of_types_are_joined(tmp_path):
    position, names = made(), np.array(["sand", "clay", "sand", "clay", "clay"])
    x, y = np.moveaxis(position, -1, 0)
    np.savez(tmp_path / "xy.npz", x=x, y=y, vx=2 * x, vy=2 * y, material=names)
    run = read(tmp_path / "xy.npz")
    np.testing.assert_array_equal(run.position, position)
    np.testing.assert_array_equal(run.fields["velocity"], 2 * position)
    types = open_dataset(tmp_path / "xy.npz").metadata.particle_types
    assert [types[i] for i in run.particle_type.tolist()] == names.tolist()
    renamed = open_dataset(tmp_path / "xy.npz", options=Options(types={0: "mud"}))
    assert renamed.metadata.particle_types == {0: "mud", 1: "sand"}
    np.testing.assert_array_equal(next(renamed.splits["train"]()).particle_type, run.particle_type)


def test_facts_beside_the_arrays_are_taken(tmp_path):
    facts = {
        "bounds": ((0.0, 1.0), (0.0, 2.0)),
        "boundary": ("periodic", "wall"),
        "particle_volume": 1e-3,
        "dt": 0.1,
        "static_types": frozenset({1}),
    }
    stored = {name: np.array(sorted(value) if name == "static_types" else value) for name, value in facts.items()}
    types, names = np.arange(PARTICLES) % 2, np.array(["water", "lid"])
    np.savez(tmp_path / "a.npz", position=made(), particle_type=types, type_names=names, **stored)
    dataset = open_dataset(tmp_path / "a.npz")
    assert {name: getattr(dataset.metadata, name) for name in facts} == facts
    assert dataset.metadata.particle_types == {0: "water", 1: "lid"}
    assert dataset.unknown == {"gravity", "sequence_length"}


def test_swapped_axes_are_refused_with_the_mend(tmp_path):
    position, types = made(frames=30, particles=20).swapaxes(0, 1), np.zeros(20, int)
    np.savez(tmp_path / "swapped.npz", position=position, types=types)
    with pytest.raises(DataError, match=r"swapped.npz: the axes of positions \(20, 30, 2\) look swapped: there are 20"):
        read(tmp_path / "swapped.npz")


def fast_lattice(frames: int = 12) -> np.ndarray:
    """(T, N, 2) lattice whose particles come 20 spacings further in a frame: right, and as swapped as it looks."""
    lattice = 0.01 * np.stack(np.meshgrid(*[np.arange(9.0)] * 2), -1).reshape(1, -1, 2)
    return lattice + np.arange(frames)[:, None, None] * np.array([0.2, 0.1]) + np.arange(3.0).reshape(3, 1, 1, 1)


@pytest.mark.parametrize("position", [fast_lattice(), made(frames=30, particles=20).swapaxes(0, 1)], ids=["no", "yes"])
def test_axes_that_look_swapped_are_a_finding_that_an_option_overrules(tmp_path, position):
    np.save(tmp_path / "bare.npy", position)
    notes = convert(tmp_path / "bare.npy", tmp_path / "native")
    assert any("look swapped" in note for note in notes)
    first = inspect(FolderSource(tmp_path / "native")).findings[0]
    assert (first.kind, first.severity) == ("axes", "contradiction")
    assert "np.swapaxes(position, 0, 1). Or state that they are so: --axes TND" in first.sentence
    notes = convert(tmp_path / "bare.npy", tmp_path / "stated", options=Options(axes="TND"))
    assert not any("look swapped" in note for note in notes)
    for source in (FolderSource(tmp_path / "stated"), FolderSource(tmp_path / "native", Options(axes="TND"))):
        assert "axes" not in {finding.kind for finding in inspect(source).findings}
    with pytest.raises(ConfigError, match="axes = NTD: positions are read as TND"):
        Options(axes="NTD")


def test_objects_are_not_unpickled(tmp_path):
    ragged = np.array([made(), made(frames=7)], dtype=object)
    np.savez(tmp_path / "ragged.npz", ragged=ragged, position=made())
    assert any("ragged object (2,)" in note for note in open_dataset(tmp_path / "ragged.npz").notes)
    np.save(tmp_path / "ragged.npy", ragged)
    with pytest.raises(DataError, match=r"ragged\.npy"):
        open_dataset(tmp_path / "ragged.npy", "arrays")


def test_a_sample_of_taichi_is_read(recorded):
    path = recorded / "third-party" / "taichi-mpm128"
    assert splits(path) == {"train": 6, "valid": 1, "test": 1}
    with np.load(path / "mpm128.npz") as content:
        np.testing.assert_array_equal(read(path, "test").position, content["positions"][7])


def test_texts_in_archives_are_types_or_left_out_or_refused_with_the_mend(tmp_path):
    names = np.array(["sand", "clay", "sand", "clay", "clay"])
    np.savez(tmp_path / "a.npz", position=made(), types=names[:, None], units="mm", dt="0.1 s")
    dataset = open_dataset(tmp_path / "a.npz")
    run = next(dataset.splits["train"]())
    assert [dataset.metadata.particle_types[number] for number in run.particle_type] == names.tolist()
    assert any("Left out, as they fit neither: units <U2 (), dt <U5 ()" in note for note in dataset.notes)
    np.savez(tmp_path / "b.npz", position=made(), types=names.astype(object))
    with pytest.raises(DataError, match=r"b\.npz: types: holds Python objects.* texts by \.astype\(str\)"):
        read(tmp_path / "b.npz")


def write_v73(path: Path, arrays: dict, cells: dict) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = np.atleast_2d(np.asarray(values, float)).T
        for name, runs in cells.items():
            inside = [file.create_dataset(f"#refs#/{chr(97 + i)}", data=run.T).ref for i, run in enumerate(runs)]
            file.create_dataset(name, data=np.array([inside], h5py.ref_dtype).T, dtype=h5py.ref_dtype)
        file["note"] = np.frombuffer("mm".encode("utf-16-le"), np.uint16)[:, None]
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")


@pytest.mark.parametrize("old", [True, False])
def test_arrays_structs_and_cells_are_read(tmp_path, old):
    runs, facts = [made(seed) for seed in range(4)], {"dt": 0.02, "types": np.array([[1.0], [1], [2], [2], [2]])}
    for name, content in (("one", {"position": runs[0]}), ("many", {})):
        path, cells = tmp_path / f"{name}.mat", {} if content else {"runs": runs}
        if old:
            cell = np.empty((1, len(runs)), object)
            cell[0] = [*runs]
            scipy.io.savemat(path, {**content, **facts, "note": "mm", **({} if content else {"runs": cell})})
        else:
            write_v73(path, {**content, **facts}, cells)
        dataset = open_dataset(path)
        read = [
            run for split in ("train", "valid", "test") if split in dataset.splits for run in dataset.splits[split]()
        ]
        assert (len(read), dataset.metadata.dt) == (1 if content else 4, 0.02)
        for run, expected in zip(read, runs, strict=False):
            np.testing.assert_allclose(run.position, expected, rtol=1e-6)
            assert run.particle_type.tolist() == [1, 1, 2, 2, 2]


def test_damaged_files_are_named(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"position": made(0)}, do_compression=True)
    content = bytearray((tmp_path / "a.mat").read_bytes())
    content[200:] = bytes(len(content) - 200)
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.mat: cannot be read as a MATLAB file"):
        open_dataset(tmp_path / "a.mat")


T, N = 12, 6
RUN = np.random.default_rng(0).random((T, N, 3)).round(5)
WALL = np.random.default_rng(1).random((1, 3, 3)).repeat(T, axis=0)


def npy(path: Path, t: int) -> None:
    np.save(path / f"frame_{t:04}.npy", RUN[t])


def npz(path: Path, t: int) -> None:
    """As GeoTaichi."""
    np.savez(
        path / f"MPMParticle{t:06}.npz",
        t_current=np.array([0.01 * t]),
        position=RUN[t],
        velocity=RUN[t],
        volume=RUN[t, :, 0],
    )


def one_frame_of_one_run(path: Path, t: int) -> None:
    np.savez(path / f"{t}.npz", positions=RUN[t : t + 1], time=0.01 * t)


def components(path: Path, t: int) -> None:
    """As PySPH."""
    with h5py.File(path / f"dam_{100 * t}.hdf5", "w") as file:
        file.create_group("solver_data").attrs.update({"t": 0.01 * t, "dt": 1e-4, "count": 100 * t})
        arrays = {name: RUN[t, :, axis] for axis, name in enumerate("xyz")}
        file.update({f"particles/fluid/arrays/{name}": array for name, array in arrays.items()})
        file.update({f"particles/fluid/arrays/{name}": RUN[t, :, 0] for name in "uvw"})


def table(path: Path, t: int) -> None:
    """As CB-Geo."""
    names = ["coord_x", "coord_y", "coord_z", "velocity_x", "velocity_y", "velocity_z"]
    rows = np.zeros(N, [("id", "i8"), *((name, "f8") for name in names)])
    order = np.random.default_rng(t).permutation(N)
    rows["id"] = order
    for axis in range(3):
        rows[names[axis]] = rows[names[axis + 3]] = RUN[t, order, axis]
    with h5py.File(path / f"particles{t:02}.h5", "w") as file:
        file["table"] = rows


@pytest.mark.parametrize("write", [npy, npz, one_frame_of_one_run, components, table], ids=lambda write: write.__name__)
def test_a_file_per_frame(tmp_path: Path, write: Callable[[Path, int], None]) -> None:
    (tmp_path / "data" / "run").mkdir(parents=True)
    for t in range(T):
        write(tmp_path / "data" / "run", t)
    convert(tmp_path / "data", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(trajectory.position, RUN.astype("f4"))
    assert ("velocity" in trajectory.fields) == (write in (npz, components, table))
    if "time" in trajectory.fields:
        np.testing.assert_allclose(trajectory.fields["time"], 0.01 * np.arange(T))
        assert read_metadata(tmp_path / "out").dt == pytest.approx(0.01)


def groups(file: Path) -> None:
    with h5py.File(file, "w") as content:
        for t in reversed(range(T)):
            content[f"frame_{t}/pos"] = RUN[t]
            content[f"frame_{t}"].attrs["time"] = 0.01 * t


def h5part(file: Path) -> None:
    with h5py.File(file, "w") as content:
        for t in range(T):
            content.update({f"Step#{t}/{name}": RUN[t, :, axis] for axis, name in enumerate("xyz")})


def unnamed(file: Path) -> None:
    np.savez(file.with_suffix(".npz"), *RUN)


@pytest.mark.parametrize("write", [groups, h5part, unnamed], ids=lambda write: write.__name__)
def test_many_frames_in_a_file(tmp_path: Path, write: Callable[[Path], None]) -> None:
    (tmp_path / "data").mkdir()
    write(tmp_path / "data" / "run.h5")
    convert(tmp_path / "data", tmp_path / "out")
    np.testing.assert_array_equal(Split(tmp_path / "out" / "train.h5").read(0).position, RUN.astype("f4"))


def save(path: Path, content: Mapping[str, np.ndarray]) -> None:
    with h5py.File(path, "w") as file:
        file.update(content)


def test_groups_are_materials_and_grids_are_none(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    for t in range(T):
        ids = {"particles/fluid/id": np.arange(N), "particles/wall/id": np.arange(3)}
        positions = {"particles/fluid/x": RUN[t], "particles/wall/x": WALL[t], "grid/position": np.zeros((9, 3))}
        save(tmp_path / "data" / f"out_{t}.h5", ids | positions)
    convert(tmp_path / "data", tmp_path / "out")
    trajectory, metadata = Split(tmp_path / "out" / "train.h5").read(0), read_metadata(tmp_path / "out")
    assert metadata.particle_types == {0: "fluid", 1: "wall"}
    assert metadata.static_types == {1}
    np.testing.assert_array_equal(trajectory.particle_type, [0] * N + [1] * 3)
    np.testing.assert_array_equal(trajectory.position, np.concatenate([RUN, WALL], axis=1).astype("f4"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"positions": RUN[0]}, r"this is one frame.*np\.stack\(frames\)"),
        ({"x": RUN[0, :, 0], "y": RUN[0, :-1, 1]}, r"positions are \(T, N, D\)"),
    ],
    ids=["alone", "lengths"],
)
def test_one_frame_is_no_run(tmp_path: Path, content: Mapping[str, np.ndarray], message: str) -> None:
    save(tmp_path / "a.h5", content)
    with pytest.raises(DataError, match=message):
        open_dataset(tmp_path / "a.h5")
