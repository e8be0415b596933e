"""DeepMind's datasets and the records in their files."""

import pickle
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import Options, convert
from nmpm.data.convert.deepmind import crc32c, masked_crc, read_record, record_offsets
from nmpm.data.format import Split, read_metadata
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import ConfigError, DataError
from tests.data.convert import records


@given(st.binary(max_size=300))
@settings(deadline=None, max_examples=10)  # the first call compiles
def test_checksums_equal_those_computed_bit_by_bit(data):
    assert crc32c(b"123456789") == 0xE3069283  # RFC 3720, appendix B.4 and the catalogue of CRCs
    assert crc32c(data) == records.crc32c(data)
    assert struct.pack("<I", masked_crc(data)) == records.masked(data)


@given(
    integers=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5),
    floats=st.lists(st.floats(width=32, allow_nan=False), max_size=5),
    strings=st.lists(st.binary(max_size=20), max_size=4),
    name=st.text(min_size=1, max_size=8),
)
@settings(max_examples=10, deadline=None)
def test_every_kind_of_feature_is_read(tmp_path_factory, integers, floats, strings, name):
    payload = records.sequence_example(
        {"integers": records.integer_feature(*integers), "floats": records.float_feature(np.array(floats))},
        {name: [records.bytes_feature(*strings), records.bytes_feature()]},
    )
    path = records.write_records(tmp_path_factory.mktemp("r") / "train.tfrecord", records.record(payload))
    example = read_record(path, 0, 0)
    assert np.asarray(example.context["integers"]).tolist() == integers
    np.testing.assert_array_equal(example.context["floats"], np.array(floats, np.float32))
    assert [list(feature) for feature in example.steps[name]] == [strings, []]


def test_cut_files_and_flipped_bits_are_refused_by_name(tmp_path):
    rng = np.random.default_rng(0)
    made = [records.trajectory_record(rng.random((2, 3, 2)), [5, 5, 3]) for _ in range(3)]
    path = records.write_records(tmp_path / "train.tfrecord", *made)
    whole = path.read_bytes()
    assert record_offsets(path) == [i * (len(whole) // 3) for i in range(3)]
    for place in rng.integers(0, len(whole), 20).tolist():
        if place % (len(whole) // 3):  # nothing tells a file cut between records from a shorter one
            path.write_bytes(whole[:place])
            with pytest.raises(DataError, match=r"train\.tfrecord: record \d"):
                record_offsets(path)
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with pytest.raises(DataError, match=r"train\.tfrecord: record \d"):
            [read_record(path, offset, index) for index, offset in enumerate(record_offsets(path))]


@pytest.fixture
def folder(tmp_path):
    return records.write_dataset(tmp_path / "ramps")


def test_all_values_are_converted(folder, tmp_path):
    notes = convert(folder, tmp_path / "native", options=Options("jax-sph", {5: "oil", 3: "boundary"}))
    assert any("jax-sph family" in note for note in notes)
    split = Split(tmp_path / "native" / "train.h5")
    assert len(split) == 2
    for index in range(2):
        position, particle_type = records.made(seed=index)
        trajectory = split.read_with_fields(index)
        np.testing.assert_array_equal(trajectory.position, position)
        np.testing.assert_array_equal(trajectory.particle_type, particle_type)
        np.testing.assert_array_equal(trajectory.fields["step_context"], np.full((8, 6), index))
        assert trajectory.attributes["key"] == 7
    metadata = read_metadata(tmp_path / "native")
    assert metadata.particle_types[5] == "oil"
    assert metadata.static_types == {1, 3}
    assert metadata.extra["default_connectivity_radius"] == 0.015
    assert infer_scene(tmp_path / "native").obstacles


def test_a_single_file_is_a_dataset(folder, tmp_path):
    (folder / "test.tfrecord").rename(folder / "test_sub.tfrecord")
    notes = convert(folder / "test_sub.tfrecord", tmp_path / "native")
    assert (tmp_path / "native" / "test.h5").is_file()
    assert any("test_sub.tfrecord becomes the test split" in note for note in notes)


def test_inconsistent_content_is_refused_by_name(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"gravity = .* each of the data's 2 axes"):
        convert(folder, tmp_path / "native", options=Options(gravity=(0.0, 0.0, -9.81)))
    records.write_dataset(folder, dim=3, bounds=[[0, 1]] * 3)
    with pytest.raises(DataError, match=r"record 0: 8 frames, 4 particles: each frame needs 4 x 3 .* has 8"):
        convert(folder, tmp_path / "native")
    payload = records.sequence_example({"key": records.integer_feature(0)}, {"place": [records.bytes_feature(b"")]})
    records.write_records(folder / "train.tfrecord", records.record(payload))
    with pytest.raises(DataError, match=r"needs the features `particle_type` and `position`; found key, place"):
        convert(folder, tmp_path / "native")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["ramps"]


def test_recorded_sand_equals_the_pickled_rollout(recorded, tmp_path):
    convert(recorded / "deepmind-sand-subset", tmp_path / "sand", "deepmind")
    convert(recorded / "deepmind-sand-subset" / "rollout_test_s0.pkl", tmp_path / "rollout")
    trajectory = Split(tmp_path / "sand" / "test.h5").read(0)
    rolled = Split(tmp_path / "rollout" / "test.h5").read_with_fields(0)
    assert trajectory.position.shape == (321, 256, 2)
    assert set(trajectory.particle_type.tolist()) == {6}
    np.testing.assert_array_equal(rolled.position, trajectory.position[:320])
    assert rolled.fields["predicted_rollout"].shape == (320, 256, 2)
    # Only these bytes, of a file whose content is known, are unpickled outside of the converter.
    with (recorded / "deepmind-sand-subset" / "rollout_test_s0.pkl").open("rb") as file:
        rollout = pickle.load(file)  # noqa: S301
    truth = np.concatenate([rollout["initial_positions"], rollout["ground_truth_rollout"]])
    np.testing.assert_array_equal(trajectory.position[:320], truth)


@pytest.mark.slow
def test_recorded_forces_and_a_moving_tool_are_kept(recorded, tmp_path):
    notes = convert(recorded / "mpm-excavation-3d", tmp_path / "sand")
    trajectory = Split(tmp_path / "sand" / "train.h5").read_with_fields(0)
    assert (trajectory.position.shape, trajectory.fields["force"].shape) == ((11, 26945, 3), (11, 3))
    tool = trajectory.position[:, trajectory.particle_type == 3]
    assert np.abs(tool[-1] - tool[0]).max() > 1e-3
    assert any("static type move in 1 of 1" in note for note in notes)
