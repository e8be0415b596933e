"""Pickled rollouts, the .npz files of objects of geoelements/gns, and what the unpickler refuses."""

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nmpm.data.convert import Options, convert
from nmpm.data.convert.pickles import load_pickled
from nmpm.data.format import Split, read_metadata
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import DataError

METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 9, "dim": 2, "dt": 0.0025,
            "vel_std": np.array([1e-3, 1e-3])}  # fmt: skip
KINDS = st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_])


def rollout(**changes: object) -> dict:
    rng = np.random.default_rng(0)
    made = {key: rng.uniform(0.2, 0.8, (n, 4, 2)).astype(np.float32) for key, n in (
        ("initial_positions", 6), ("predicted_rollout", 4), ("ground_truth_rollout", 4))}  # fmt: skip
    return made | {"particle_types": np.array([5, 5, 6, 3]), "metadata": METADATA} | changes


def write(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


class Runs:
    """A pickle that runs something when it is loaded."""

    def __init__(self, function, *arguments):
        self.what = function, arguments

    def __reduce__(self):
        return self.what


@given(array=arrays.arrays(KINDS, arrays.array_shapes(min_side=0)), protocol=st.integers(0, 5))
@settings(deadline=None, max_examples=10)
def test_arrays_come_back_as_they_were(array, protocol):
    nested = np.empty(2, object)
    nested[:] = array, [1, "text"]
    content = {"a": array, "b": [array.T, ("text", 1.5, None, array.dtype.type(1))], "c": nested}
    back = load_pickled(pickle.dumps(content, protocol), "here")
    assert back["a"].dtype == array.dtype
    for values, expected in ((back["a"], array), (back["b"][0], array.T), (back["c"][0], array)):
        np.testing.assert_array_equal(values, expected)
    assert back["b"][1] == ("text", 1.5, None, array.dtype.type(1))
    assert back["c"][1] == [1, "text"]


@pytest.mark.parametrize(
    ("evil", "named"),
    [
        (Runs(os.system, "touch PLACE"), "posix.system"),
        (Runs(getattr, "", "join"), "getattr"),
        (Runs(np.fromfile, "PLACE"), "fromfile"),
        (Runs(bytearray, 10), "bytearray"),
    ],
    ids=["os", "getattr", "numpy", "bytearray"],
)
def test_pickles_that_request_other_names_are_refused(evil, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for content in (evil, [1, {"deep": (evil,)}], np.array([evil, None])):
        for protocol in (0, 2, 4):
            with pytest.raises(DataError, match=f"here: cannot be read as pickled arrays: it requests .*{named}"):
                load_pickled(pickle.dumps(content, protocol), "here")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("protocol", [2, 4])
def test_a_rollout_becomes_a_trajectory_with_its_prediction(tmp_path, protocol):
    content = rollout(particle_types=np.array([5, 5, np.int64(6), 3], object))
    notes = convert(write(tmp_path / "rollout_test_0.pkl", content, protocol), tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "test.h5").read_with_fields(0)
    truth = np.concatenate([content["initial_positions"], content["ground_truth_rollout"]])
    predicted = np.concatenate([content["initial_positions"], content["predicted_rollout"]])
    np.testing.assert_array_equal(trajectory.position, truth)
    np.testing.assert_array_equal(trajectory.fields["predicted_rollout"], predicted)
    assert trajectory.particle_type.tolist() == [5, 5, 6, 3]
    assert any("predicted_rollout" in note for note in notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"initial_positions": 1}, r"a rollout is a dict of initial_positions, ground_truth"),
        (rollout(particle_types=np.array([5, 5])), r"rollout_0\.pkl: .*4 particles but particle_type has 2"),
        (rollout(particle_types=np.array(["a", 5, 5, 3], object)), "expected numbers, found other objects"),
        (rollout(initial_positions=[[1.0]]), "initial_positions: expected an array of numbers, found list"),
        (rollout(metadata=[]), "metadata must map keys to values"),
    ],
    ids=["keys", "count", "objects", "list", "metadata"],
)
def test_other_content_is_refused_by_name(tmp_path, content, message):
    with pytest.raises(DataError, match=message):
        convert(write(tmp_path / "rollout_0.pkl", content), tmp_path / "out")


GNS_METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 7, "dim": 2, "dt": 0.0025}


def positions(seed: int, particles: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (7, particles, 2)).astype(np.float32)


def pair(*parts: object) -> np.ndarray:
    array = np.empty(len(parts), object)
    array[:] = parts
    return array


def write_gns(folder: Path, **members: np.ndarray) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(GNS_METADATA))
    np.savez(folder / "train.npz", **members)
    return folder


def test_trajectories_are_ordered_by_number(tmp_path):
    made = {f"simulation_trajectory_{i}": pair(positions(i, 3 + i), 6) for i in (10, 2, 0)}
    convert(write_gns(tmp_path / "sand", **made), tmp_path / "out")
    split = Split(tmp_path / "out" / "train.h5")
    for index, number in enumerate((0, 2, 10)):
        np.testing.assert_array_equal(split.read(index).position, positions(number, 3 + number))
        assert set(split.particle_type(index).tolist()) == {6}


def test_types_per_particle_and_material_properties_are_kept(tmp_path):
    types, angle = np.array([6, 6, 3, 3], dtype=object), np.array([20.0, 20.0, 0.0, 0.0])
    convert(write_gns(tmp_path / "a", simulation_0=pair(positions(0), types, angle)), tmp_path / "out")
    trajectory = Split(tmp_path / "out" / "train.h5").read_with_fields(0)
    assert trajectory.particle_type.tolist() == [6, 6, 3, 3]
    np.testing.assert_array_equal(trajectory.fields["material_property"], angle)


def test_reads_one_member_with_all_trajectories(tmp_path):
    rows = np.empty((2, 2), object)
    for index in range(2):
        rows[index] = [positions(index), 5]
    convert(write_gns(tmp_path / "a", gns_data=rows), tmp_path / "out")
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
def test_inconsistent_members_are_refused_by_name(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=rf"train\.npz: simulation_0.*({message})"):
        convert(write_gns(tmp_path / "a", simulation_0=content), tmp_path / "out")
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
