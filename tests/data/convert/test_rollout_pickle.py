import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nmpm.data.convert import convert
from nmpm.data.convert.pickles import load_pickled
from nmpm.data.format import Split
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
