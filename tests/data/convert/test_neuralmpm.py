"""Files written here, to the published schema: no file of theirs is at hand."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from nmpm.data.convert import Options, convert
from nmpm.data.format import Split, read_metadata
from nmpm.data.sources import FolderSource
from nmpm.errors import DataError


def write(path: Path, seed: int = 0, particles: int = 5, boundary: int = 3, **more: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(seed)
    moving = (rng.uniform(0.3, 0.6, (1, particles, 2)) + rng.normal(scale=1e-3, size=(8, particles, 2))).astype("f4")
    wall = np.broadcast_to(rng.uniform(0.1, 0.2, (1, boundary, 2)), (8, boundary, 2)).astype("f4")
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, values in ({"particles": moving, "boundary": wall} | more).items():
            file[name] = values
    return np.concatenate([moving, wall], axis=1)


def test_a_published_dataset_is_known_by_its_name(tmp_path):
    made = [write(tmp_path / "WaterRamps" / "train" / f"sim_{i}.h5", i) for i in range(11)]
    write(tmp_path / "WaterRamps" / "test" / "sim_0.h5")
    notes = convert(tmp_path / "WaterRamps", tmp_path / "out")
    split = Split(tmp_path / "out" / "train.h5")
    for index in range(11):  # 10 follows 9, not 1
        np.testing.assert_array_equal(split.read(index).position, made[index])
    assert split.particle_type(0).tolist() == [5] * 5 + [3] * 3
    metadata = read_metadata(tmp_path / "out")
    assert (metadata.dt, metadata.gravity, metadata.sequence_length) == (0.0025, (0.0, -9.81), 7)
    assert any("published WaterRamps" in note for note in notes)
    scene = FolderSource(tmp_path / "out").scene
    assert (scene.materials, scene.obstacles) == (("water",), True)


@pytest.mark.parametrize("with_boundary", [False, True])
def test_several_materials_and_gravity_per_trajectory(tmp_path, with_boundary):
    types = np.array(([0, 0, 0] if with_boundary else []) + [5, 6, 7, 5, 6])
    gravity, heat = np.array([3.0, -4.0]), np.random.default_rng(0).random((8, 5))
    write(tmp_path / "MultiMaterial" / "test" / "sim_0.h5", types=types, grav=gravity, heat=heat)
    convert(tmp_path / "MultiMaterial", tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    assert trajectory.particle_type.tolist() == [5, 6, 7, 5, 6, 3, 3, 3]
    np.testing.assert_array_equal(trajectory.attributes["gravity"], gravity)
    np.testing.assert_array_equal(trajectory.fields["grav"], gravity)
    np.testing.assert_array_equal(trajectory.fields["heat"], heat)


def test_an_unknown_dataset_needs_the_time_step_and_material(tmp_path):
    write(tmp_path / "mine" / "train" / "sim_0.h5")
    with pytest.raises(DataError, match=r"no published dataset is called 'mine'.*--dt"):
        convert(tmp_path / "mine", tmp_path / "out")
    with pytest.raises(DataError, match=r"does not state the particles' material.*--types 5=water"):
        convert(tmp_path / "mine", tmp_path / "out", options=Options(dt=0.01))
    convert(tmp_path / "mine", tmp_path / "out", options=Options(dt=0.01, types={5: "milk"}))
    assert FolderSource(tmp_path / "out").scene.materials == ("milk",)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("particles", None, "'particles' is missing"),
        ("boundary", np.zeros((3, 3, 2)), "do not match"),
        ("types", np.zeros(4, int), r"types \(4,\) match neither 5 particles"),
        ("particles", np.full((8, 5, 2), np.inf), "particle 0 in frame 0"),
    ],
)
def test_inconsistent_content_is_refused_by_name(tmp_path, name, value, message):
    path = tmp_path / "Goop" / "train" / "sim_0.h5"
    write(path)
    with h5py.File(path, "a") as file:
        if name in file:
            del file[name]
        if value is not None:
            file[name] = value
    with pytest.raises(DataError, match=rf"sim_0\.h5.*{message}"):
        convert(tmp_path / "Goop", tmp_path / "out")


def test_material_that_diverges_beside_walls_at_rest_is_named(tmp_path):
    write(tmp_path / "Goop" / "train" / "sim_0.h5")
    with h5py.File(tmp_path / "Goop" / "train" / "sim_0.h5", "a") as file:
        file["particles"][4:] = np.nan
    with pytest.raises(DataError, match=r"train split, trajectory 0.*NaN from frame 4 on.*diverged"):
        convert(tmp_path / "Goop", tmp_path / "out")
