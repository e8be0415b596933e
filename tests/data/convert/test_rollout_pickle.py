import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nmpm.data.convert import convert
from nmpm.data.convert.restricted_pickle import load_pickled, number_array
from nmpm.data.format import Split
from nmpm.errors import DataError

METADATA = {"bounds": [[0.1, 0.9], [0.1, 0.9]], "sequence_length": 9, "dim": 2, "dt": 0.0025,
            "vel_std": np.array([1e-3, 1e-3])}  # fmt: skip


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


KINDS = st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_])


@given(array=arrays.arrays(KINDS, arrays.array_shapes(min_side=0)), protocol=st.integers(0, 5))
@settings(deadline=None, max_examples=50)
def test_arrays_come_back_as_they_were(array, protocol):
    nested = np.empty(2, object)
    nested[:] = array, [1, "text"]
    content = {"a": array, "b": [array.T, ("text", 1.5, None, array.dtype.type(1))], "c": nested}
    back = load_pickled(pickle.dumps(content, protocol), "here")
    np.testing.assert_array_equal(back["a"], array)
    assert back["a"].dtype == array.dtype
    np.testing.assert_array_equal(back["b"][0], array.T)
    assert back["b"][1] == ("text", 1.5, None, array.dtype.type(1))
    np.testing.assert_array_equal(back["c"][0], array)
    assert back["c"][1] == [1, "text"]


@pytest.mark.parametrize(
    ("evil", "named"),
    [
        (Runs(os.system, "touch PLACE"), "posix.system"),
        (Runs(eval, "open('PLACE', 'w')"), "eval"),
        (Runs(getattr, "", "join"), "getattr"),
        (Runs(np.fromfile, "PLACE"), "fromfile"),
        (Runs(np.save, "PLACE", 1), "numpy.save"),
        (Runs(bytearray, 10), "bytearray"),
        (Runs(Path, "PLACE"), "pathlib"),
    ],
)
def test_pickles_that_request_other_names_are_refused(evil, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for content in (evil, [1, {"deep": (evil,)}], np.array([evil, None])):
        for protocol in (0, 2, 4):
            with pytest.raises(DataError, match=f"here: cannot be read as pickled arrays: it requests .*{named}"):
                load_pickled(pickle.dumps(content, protocol), "here")
    assert not list(tmp_path.iterdir())


def test_pickles_cannot_allocate_arrays_directly():
    for data in (pickle.dumps(Runs(np.ndarray, (2**40,))), b"\x80\x04K\x01Q."):
        with pytest.raises(DataError, match="cannot be read as pickled arrays"):
            load_pickled(data, "here")


def test_a_rollout_becomes_a_trajectory_with_its_prediction(tmp_path):
    content = rollout()
    notes = convert(write(tmp_path / "rollout_test_0.pkl", content, 2), tmp_path / "out")
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
        (rollout(initial_positions=[[1.0]]), "initial_positions: expected an array of numbers, found list"),
        (rollout(metadata=[]), "metadata must map keys to values"),
    ],
)
def test_other_content_is_refused_by_name(tmp_path, content, message):
    with pytest.raises(DataError, match=message):
        convert(write(tmp_path / "rollout_0.pkl", content), tmp_path / "out")


def test_arrays_of_number_objects_are_converted_others_refused():
    np.testing.assert_array_equal(number_array(np.array([1, 2.5, np.int64(3)], object), "here"), [1, 2.5, 3])
    with pytest.raises(DataError, match="here: expected numbers, found other objects"):
        number_array(np.array(["a", 1], object), "here")
