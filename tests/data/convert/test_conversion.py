"""Conversion into the native layout, and the cache of what is converted."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import ForeignDataset, Options, convert, native_folder
from nmpm.data.convert.base import split_runs
from nmpm.data.convert.conversion import write_native
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import Split, Trajectory, read_metadata
from nmpm.data.scene_inference import infer_scene
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError, DataError
from tests.data.convert import records
from tests.made_up import made_up_metadata, made_up_trajectory


def source_of(*trajectories: Trajectory, **changes) -> ForeignDataset:
    return ForeignDataset(made_up_metadata(**changes), {"train": lambda: iter(trajectories)})


def test_an_existing_destination_is_not_overwritten(tmp_path):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "precious.txt").write_text("mine")
    with pytest.raises(DataError, match="taken: exists already"):
        write_native(source_of(made_up_trajectory(5, 3)), tmp_path / "taken")
    assert (tmp_path / "taken" / "precious.txt").read_text() == "mine"


def test_an_error_leaves_no_files_or_is_collected(tmp_path):
    def broken():
        yield made_up_trajectory(5, 3)
        raise DataError("the second is damaged.")

    source = ForeignDataset(made_up_metadata(), {"train": broken})
    with pytest.raises(DataError, match="second is damaged"):
        write_native(source, tmp_path / "out")
    assert not list(tmp_path.iterdir())
    problems: list[str] = []
    write_native(source, tmp_path / "out", problems)
    assert problems == ["the second is damaged. Trajectories after it are not read."]
    assert len(Split(tmp_path / "out" / "train.h5")) == 1


KILLED = """
import os, signal, sys
from pathlib import Path
from nmpm.data.convert import ForeignDataset
from nmpm.data.convert.conversion import write_native
from tests.made_up import made_up_metadata, made_up_trajectory
def killed():
    yield made_up_trajectory(5, 3)
    os.kill(os.getpid(), signal.SIGKILL)
write_native(ForeignDataset(made_up_metadata(), {"train": killed}), Path(sys.argv[1]))
"""


def test_a_killed_conversion_leaves_no_dataset_and_the_next_one_removes_its_files(tmp_path):
    folder = Path(__file__).parents[3]
    assert subprocess.run([sys.executable, "-c", KILLED, tmp_path / "out"], cwd=folder, check=False).returncode < 0
    assert list(tmp_path.iterdir())
    assert not (tmp_path / "out").exists()
    write_native(source_of(made_up_trajectory(5, 3)), tmp_path / "out")
    assert [item.name for item in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(("shift", "said"), [(0.0, False), (1000.0, True)])
def test_a_conversion_notes_positions_that_float32_rounds(tmp_path, shift, said):
    run = made_up_trajectory(12, 3)
    source = source_of(dataclasses.replace(run, position=run.position + np.float32(shift)))
    metadata = dataclasses.replace(source.metadata, particle_volume=0.02**2)
    metadata = dataclasses.replace(metadata, bounds=tuple((a + shift, b + shift) for a, b in metadata.bounds))
    notes = write_native(dataclasses.replace(source, metadata=metadata), tmp_path / "out")
    assert any("Subtract about (1000." in note and note.startswith("float32: ") for note in notes) == said


def test_notes_on_inconsistencies(tmp_path):
    assert write_native(source_of(made_up_trajectory(12, 3, statics=2)), tmp_path / "consistent") == ()
    still, moving = made_up_trajectory(5, 3, statics=2), made_up_trajectory(5, 3, seed=1, statics=2)
    moving.position[:, -1, 0] += np.linspace(0, 0.1, 5, dtype=np.float32)
    moving.position[2, 0, 1] = 0.95
    notes = write_native(source_of(still, moving, extra={"vel_std": [1.0, 1.0]}), tmp_path / "out")
    said = " ".join(notes)
    assert "static type move in 1 of 2 trajectories" in said
    assert "state vel_std = (1, 1)" in said
    assert "Along y positions reach from" in said
    assert "to 0.95, beyond the stated bounds [0.1, 0.9]" in said
    assert "sequence_length 12; trajectories have 5 frames" in said
    metadata = read_metadata(tmp_path / "out")
    assert metadata.extra["stated_statistics"] == {"vel_std": [1.0, 1.0]}
    assert metadata.extra["moving_boundaries"] is True
    assert infer_scene(tmp_path / "out").domain[1][1] >= 0.95


def test_unknown_types_and_formats_are_refused_with_a_suggestion(tmp_path):
    strange = Trajectory(made_up_trajectory(5, 3).position, np.full(3, 42))
    with pytest.raises(DataError, match=r"train split, trajectory 0: unknown particle type 42"):
        write_native(source_of(strange), tmp_path / "out")
    (tmp_path / "a.dat").write_text("hello")
    with pytest.raises(DataError, match=r"no known format; found a\.dat.*write_trajectories.*your_data\.md"):
        convert(tmp_path, tmp_path / "out")
    with pytest.raises(DataError, match="no such file or folder"):
        convert(tmp_path / "nowhere", tmp_path / "out")
    with pytest.raises(ConfigError, match="There is no format 'tf'; there are native, deepmind"):
        convert(tmp_path, tmp_path / "out", "tf")


def test_stated_options_enter_the_metadata_and_types_are_renumbered(make_dataset, tmp_path):
    folder = make_dataset(statics=2)
    for ids, message in (({5: 0}, "no particle type 5"), ({7: 0, 3: 0}, "the same id"), ({7: 3}, "type 3 occurs")):
        with pytest.raises(ConfigError, match=message):
            convert(folder, tmp_path / "out", ids=ids)
        assert not (tmp_path / "out").exists()
    options = Options(types={7: "honey"}, gravity=(0.0, -1.0), dt=0.5)
    convert(folder, tmp_path / "out", options=options, ids={7: 0, 3: 1})
    metadata = read_metadata(tmp_path / "out")
    assert (metadata.particle_types, metadata.static_types) == ({0: "honey", 1: "boundary"}, {1})
    assert (metadata.dt, metadata.gravity) == (0.5, (0.0, -1.0))
    assert Split(tmp_path / "out" / "train.h5").particle_type(0).tolist() == [0] * 5 + [1] * 2
    for name in ("train", "valid", "test"):
        old, new = Split(folder / f"{name}.h5"), Split(tmp_path / "out" / f"{name}.h5")
        for index in range(len(old)):
            np.testing.assert_array_equal(old.read(index).position, new.read(index).position)


def test_recorded_fields_and_periodic_axes_survive(recorded, tmp_path):
    (tmp_path / "old").mkdir()
    for name in ("test.h5", "metadata.json"):
        (tmp_path / "old" / name).symlink_to(recorded / "jaxsph-heated-channel-2d" / name)
    convert(tmp_path / "old", tmp_path / "new", options=Options("jax-sph", boundary=("periodic", "wall"), dt=0.04545))
    new = Split(tmp_path / "new" / "test.h5")
    with h5py.File(tmp_path / "old" / "test.h5") as file:
        for index, group in enumerate(file.values()):
            read = new.read_with_fields(index)
            np.testing.assert_array_equal(read.fields["temperature"], group["temperature"][()])
            np.testing.assert_array_equal(read.position, group["position"][()])
    metadata = read_metadata(tmp_path / "new")
    assert metadata.periodic == (True, False)
    assert metadata.dt == pytest.approx(0.04545)
    assert metadata.particle_types[3] == "heated wall"
    # Shortest ways across the period: the file's own figures for the fluid.
    assert metadata.extra["vel_std"] == pytest.approx(metadata.extra["stated_statistics"]["vel_std"], rel=0.05)


pytestmark = pytest.mark.usefixtures("home")


@pytest.fixture
def foreign(tmp_path):
    return records.write_dataset(tmp_path / "ramps")


def test_is_converted_once_and_again_after_a_change(foreign):
    first = native_folder(foreign)
    stamp = (first / "train.h5").stat().st_mtime_ns
    assert native_folder(foreign) == first
    assert (first / "train.h5").stat().st_mtime_ns == stamp
    assert native_folder(foreign, Options(gravity=(0.0, -9.81))) != first
    os.utime(foreign / "train.tfrecord", ns=(1, 1))
    assert native_folder(foreign) != first


def test_other_formats_can_be_trained_on_directly(foreign):
    data = TrajectoryDataModule(path=str(foreign), gravity=[0.0, -9.81], horizon=4, batch_size=1)
    data.prepare_data()
    data.setup("fit")
    assert data.scene.obstacles
    assert data.scene.gravity == (0.0, -9.81)
    frames = next(iter(data.train_dataloader())).initial.position[0].numpy()
    rows = [records.made(seed=seed)[0][first, :3] for seed in range(2) for first in range(8)]
    assert any(np.allclose(frames, row, atol=1e-7) for row in rows)


def test_a_gravity_that_contradicts_a_foreign_format_is_refused(foreign):
    records.write_dataset(foreign, gravity=[0.0, -9.81])
    native_folder(foreign, Options(gravity=(0.0, -9.81)))
    for _ in range(2):  # from the cache too
        with pytest.raises(ConfigError, match=r"\[0.0, -1.0\] contradicts .*ramps/metadata.json.*\[0.0, -9.81\]"):
            native_folder(foreign, Options(gravity=(0.0, -1.0)))


def test_a_gravity_that_is_only_assumed_may_be_stated(tmp_path):
    dmcf = pytest.importorskip("tests.data.convert.test_dmcf", reason="the extra `convert` is not installed")
    flow = dmcf.write(tmp_path / "flow" / "a.msgpack.zst", dmcf.frames()).parent
    assert read_metadata(native_folder(flow)).gravity == (0.0, -9.81, 0.0)
    assert read_metadata(native_folder(flow, Options(gravity=(0.0, -1.0, 0.0)))).gravity == (0.0, -1.0, 0.0)


def test_types_that_are_found_to_rest_do_so_under_the_names_that_a_user_states(tmp_path):
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 1, (4, 1, 40, 2)) + 1e-3 * rng.normal(size=(4, 30, 40, 2)).cumsum(axis=1)
    position[:, :, 30:] = position[:1, :1, 30:]
    np.savez(tmp_path / "a.npz", position=position, types=np.repeat([0, 1], [30, 10]))
    data = TrajectoryDataModule(path=str(tmp_path / "a.npz"))
    assert data.data_source.metadata.static_types == {1}
    source = FolderSource(tmp_path / "a.npz", Options(types={0: "dust", 1: "grate"}))
    assert source.metadata.static_types == {1}
    assert (source.scene.materials, source.scene.obstacles) == (("dust",), True)


@pytest.mark.parametrize(
    ("count", "sizes"),
    [(0, {}), (2, {"train": 2}), (3, {"train": 1, "valid": 1, "test": 1}), (40, {"train": 32, "valid": 4, "test": 4})],
)
def test_the_last_tenths_of_the_runs_test_and_validate(count, sizes):
    parts = split_runs(count)
    assert {split: len(part) for split, part in parts.items()} == sizes
    assert sorted(run for part in parts.values() for run in part) == list(range(count))
