import numpy as np
import pytest

import nmpm
from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.sources import FolderSource
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


def test_swapped_axes_are_refused(tmp_path):
    position, types = runs()[0].position, np.zeros(5, int)
    with pytest.raises(DataError, match=r"7 particles but particle_type has 5\. Are its axes swapped\?.*swapaxes"):
        nmpm.Trajectory(position.swapaxes(0, 1), types)
    for bare in (position, position[:5], position[:1]):
        nmpm.write_trajectories(tmp_path / "right" / "train.h5", [bare], ONE)
    square = position[:5].swapaxes(0, 1)
    for swapped in (position.swapaxes(0, 1), square, nmpm.Trajectory(square, types)):
        with pytest.raises(DataError, match=r"trajectory 0: the axes of positions \(5, \d, 2\) look swapped.*swapaxes"):
            nmpm.write_trajectories(tmp_path / "train.h5", [swapped], ONE)


def test_splits_of_different_scenes_do_not_mix(tmp_path):
    nmpm.write_trajectories(tmp_path / "train.h5", runs(), SCENE)
    with pytest.raises(DataError, match="states another scene"):
        nmpm.write_trajectories(tmp_path / "test.h5", [np.zeros((3, 2, 2))], ONE)
    with pytest.raises(ConfigError, match="must be named train"):
        nmpm.write_trajectories(tmp_path / "mine.h5", runs(), SCENE)
