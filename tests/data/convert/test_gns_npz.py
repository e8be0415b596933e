import json
from pathlib import Path

import numpy as np
import pytest

from nmpm.data.convert import Options, convert
from nmpm.data.format import Split, read_metadata
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import DataError
from tests.data.convert.test_rollout_pickle import Runs

METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 7, "dim": 2, "dt": 0.0025}


def positions(seed: int, particles: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (7, particles, 2)).astype(np.float32)


def pair(*parts: object) -> np.ndarray:
    array = np.empty(len(parts), object)
    array[:] = parts
    return array


def write(folder: Path, **members: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(METADATA))
    np.savez(folder / "train.npz", **members)
    return folder


def test_trajectories_are_ordered_by_number(tmp_path):
    made = {f"simulation_trajectory_{i}": pair(positions(i, 3 + i), 6) for i in (10, 2, 0)}
    convert(write(tmp_path / "sand", **made), tmp_path / "out")
    split = Split(tmp_path / "out" / "train.h5")
    for index, number in enumerate((0, 2, 10)):
        np.testing.assert_array_equal(split.read(index).position, positions(number, 3 + number))
        assert set(split.particle_type(index).tolist()) == {6}


def test_types_per_particle_and_material_properties_are_kept(tmp_path):
    types, angle = np.array([6, 6, 3, 3], dtype=object), np.array([20.0, 20.0, 0.0, 0.0])
    convert(write(tmp_path / "a", simulation_0=pair(positions(0), types, angle)), tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    assert trajectory.particle_type.tolist() == [6, 6, 3, 3]
    np.testing.assert_array_equal(trajectory.fields["material_property"], angle)


def test_reads_one_member_with_all_trajectories(tmp_path):
    rows = np.empty((2, 2), object)
    for index in range(2):
        rows[index] = [positions(index), 5]
    convert(write(tmp_path / "a", gns_data=rows), tmp_path / "out")
    split = Split(tmp_path / "out" / "train.h5")
    assert len(split) == 2
    np.testing.assert_array_equal(split.read(1).position, positions(1))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pair(positions(0)), "found 1 parts"),
        (positions(0), "found 7 parts"),
        (pair(positions(0)[0], 5), r"shape \(T, N, D\)"),
        (pair(positions(0), np.arange(3)), "one for each of 4 particles"),
        (pair(positions(0) * [np.nan, 1], 5), "finite"),
        (
            pair(positions(0), Runs(Path.touch, Path("ran"))),
            r"requests pathlib\.Path\.touch|requests builtins\.getattr",
        ),
    ],
    ids=["parts", "numbers", "shape", "types", "nan", "pickle"],
)
def test_inconsistent_content_is_refused_by_name(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=rf"train\.npz: simulation_0.*({message})"):
        convert(write(tmp_path / "a", simulation_0=content), tmp_path / "out")
    assert [item.name for item in tmp_path.iterdir()] == ["a"]


def test_recorded_flume(recorded, tmp_path):
    flume = recorded / "taichi-wave-flume-2d"
    with pytest.raises(DataError, match=r"unknown particle type 1 .*--types 1=sand"):
        convert(flume, tmp_path / "nameless")
    notes = convert(flume, tmp_path / "flume", options=Options(types={1: "debris"}))
    trajectory = Split(tmp_path / "flume" / "test.h5").read(0)
    assert trajectory.position.shape == (400, 738, 2)
    assert np.bincount(trajectory.particle_type).tolist() == [0, 62, 0, 0, 0, 676]
    said = " ".join(notes)
    assert "Along x positions reach from 0.02015 to 0.9966" in said
    assert "vel_std = (0.399, 0.136)" in said
    scene = infer_scene(tmp_path / "flume")
    assert scene.materials == ("debris", "water")
    low, high = trajectory.position.min((0, 1)), trajectory.position.max((0, 1))
    assert all(a <= b and c <= d for (a, d), b, c in zip(scene.domain, low, high, strict=True))
    assert read_metadata(tmp_path / "flume").extra["vel_std"] == pytest.approx([8.2e-4, 2.4e-4], rel=0.02)
