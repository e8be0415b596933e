import re

import numpy as np
import pytest

import nmpm
from nmpm.data.format import Split, read_metadata
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError, DataError

SCENE = nmpm.Scene(
    ((0.0, 1.0), (0.0, 0.5)), ((-0.05, 1.05), (-0.05, 0.55)), 0.01, ("honey", "milk"), 1e-4,
    gravity=(0.0, -9.81), obstacles=True,
)  # fmt: skip
ONE = nmpm.Scene(((0.0, 1.0),) * 2, ((-0.1, 1.1),) * 2, 0.01, ("honey",), 1e-4)
TYPES = np.array([0, 0, 1, 1, 2])


def runs(number: int = 2, frames: int = 7) -> list[nmpm.Trajectory]:
    rng = np.random.default_rng(0)
    made = []
    for i in range(number):
        position = np.repeat(rng.uniform(0.1, 0.4, (1, 5, 2)), frames, axis=0)
        position[:, :4, 0] += 0.01 * np.arange(frames)[:, None]
        made.append(nmpm.Trajectory(position, TYPES, {"seed": i}, {"heat": rng.random((frames, 5))}))
    return made


def test_written_trajectories_can_be_trained_on(tmp_path):
    nmpm.write_trajectories(tmp_path / "mine" / "train.h5", iter(runs()), SCENE)
    nmpm.write_trajectories(tmp_path / "mine" / "test.h5", runs(1, 9), SCENE)
    origin = FolderSource(tmp_path / "mine")
    assert origin.scene == SCENE
    recording = origin.recordings("train")[1]
    np.testing.assert_array_equal(recording.frames.numpy(), runs()[1].position[:, :4])
    assert recording.material.tolist() == [0, 0, 1, 1]
    assert recording.obstacle.shape == (1, 2)
    whole = Split(tmp_path / "mine" / "train.h5").read_with_fields(0)
    np.testing.assert_array_equal(whole.fields["heat"], runs()[0].fields["heat"])
    assert whole.attributes == {"seed": 0}
    assert read_metadata(tmp_path / "mine").sequence_length == 9


def test_bare_arrays_suffice_for_one_material(tmp_path):
    position = np.random.default_rng(0).random((6, 3, 2))
    nmpm.write_trajectories(tmp_path / "train.h5", [position], ONE)
    np.testing.assert_array_equal(Split(tmp_path / "train.h5").read(0).position, position.astype(np.float32))
    with pytest.raises(DataError, match="trajectory 0 is a bare array, but the scene has 3 particle types"):
        nmpm.write_trajectories(tmp_path / "other" / "train.h5", [position], SCENE)


@pytest.mark.parametrize(
    ("position", "types", "message"),
    [
        (runs()[0].position + 1, TYPES, r"trajectory 0, frame 0: particle \d is at .* outside the domain"),
        (runs()[0].position, TYPES + 1, r"has particle types \[1, 2, 3\]; the scene has 0 honey, 1 milk, 2 boundary"),
        (runs()[0].position[..., :1], TYPES, "has 1 axes, the scene has 2"),
    ],
    ids=["position", "types", "axes"],
)
def test_trajectories_that_do_not_fit_the_scene_are_refused_and_nothing_is_written(tmp_path, position, types, message):
    with pytest.raises(DataError, match=message):
        nmpm.write_trajectories(tmp_path / "train.h5", [nmpm.Trajectory(position, types)], SCENE)
    assert not list(tmp_path.iterdir())


def test_swapped_axes_are_refused_where_types_tell_and_else_named(tmp_path, caplog):
    position, types = runs()[0].position, np.zeros(5, int)
    with pytest.raises(DataError, match=r"7 particles but particle_type has 5\. Are its axes swapped\?.*swapaxes"):
        nmpm.Trajectory(position.swapaxes(0, 1), types)
    for bare in (position, position[:5], position[:1]):
        nmpm.write_trajectories(tmp_path / "right" / "train.h5", [bare], ONE)
    assert not caplog.messages
    nmpm.write_trajectories(tmp_path / "swapped" / "train.h5", [position.swapaxes(0, 1)], ONE)
    (message,) = caplog.messages
    assert re.search(r"trajectory 0: the axes of positions look swapped: .* of \(5, 7, 2\).*swapaxes", message)


def test_splits_of_different_scenes_do_not_mix(tmp_path):
    nmpm.write_trajectories(tmp_path / "train.h5", runs(), SCENE)
    with pytest.raises(DataError, match="states another scene"):
        nmpm.write_trajectories(tmp_path / "test.h5", [np.zeros((3, 2, 2))], ONE)
    with pytest.raises(ConfigError, match="must be named train"):
        nmpm.write_trajectories(tmp_path / "mine.h5", runs(), SCENE)


def wandering(count: int, frames: int = 30) -> np.ndarray:
    rng = np.random.default_rng(1)
    start = rng.uniform(0.2, 0.8, (count, 1, 40, 2))
    return (start + 1e-3 * rng.normal(size=(count, frames, 40, 2)).cumsum(axis=1)).astype(np.float32)


@pytest.mark.usefixtures("home")
def test_arrays_alone_become_a_dataset(tmp_path, capsys):
    position = wandering(10)
    types = np.arange(40) % 2
    runs = [{"position": run, "types": types, "heat": np.ones(40)} for run in position]
    nmpm.write_trajectories(tmp_path / "grains", runs, dt=0.004, types={1: "sand"}, gravity=[0.0, -9.81])
    printed = capsys.readouterr().out
    assert "8 train, 1 valid, 1 test" in printed
    assert "bounds" in printed
    assert "dt" not in [line.split()[1] for line in printed.splitlines()]  # it was stated
    metadata = read_metadata(tmp_path / "grains")
    assert (metadata.dt, metadata.gravity, metadata.particle_types[1]) == (0.004, (0.0, -9.81), "sand")
    np.testing.assert_array_equal(Split(tmp_path / "grains" / "test.h5").read(0).position, position[9])
    data = nmpm.load_trajectories(tmp_path / "grains")
    assert [len(part) for part in data.splits.values()] == [8, 1, 1]
    np.testing.assert_array_equal(data.train[-1].position, position[7])
    assert [run.fields["heat"].shape for run in data.train[:2]] == [(40,), (40,)]
    assert data.train[3].metadata.particle_types[1] == "sand"
    assert data.scene.dt == 0.004


@pytest.mark.usefixtures("home")
def test_arrays_in_other_shapes_and_other_files_are_loaded(tmp_path):
    position = wandering(4)
    nmpm.write_trajectories(tmp_path / "stacked", position)
    nmpm.write_trajectories(tmp_path / "parts", {"train": position[:3], "test": [position[3]]}, dt=0.1)
    assert len(nmpm.load_trajectories(tmp_path / "stacked").train) == 2
    np.savez(tmp_path / "runs.npz", position=position)
    data = nmpm.load_trajectories(tmp_path / "runs.npz", dt=0.25)
    assert data.metadata.dt == 0.25
    np.testing.assert_array_equal(data.valid[0].position, position[2])
    nmpm.write_trajectories(tmp_path / "again", list(data.train))  # with the facts of its dataset
    assert read_metadata(tmp_path / "again").dt == 0.25
    with pytest.raises(DataError, match=r"no valid\.h5 there"):
        _ = nmpm.load_trajectories(tmp_path / "parts").valid
    with pytest.raises(DataError, match="nowhere: no such file or folder"):
        nmpm.load_trajectories(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"gravitation is no fact; known: .*Did you mean gravity\?"):
        nmpm.write_trajectories(tmp_path / "new", position, gravitation=9.81)
    with pytest.raises(DataError, match=r"run 1: none of the arrays is \(T, N, D\).*position \(30, 40\)"):
        nmpm.write_trajectories(tmp_path / "new", [position[0], position[0, ..., 0]])
