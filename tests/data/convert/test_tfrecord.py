import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert.tfrecord import crc32c, masked_crc, read_record, record_offsets
from nmpm.errors import DataError
from tests.data.convert import records


def test_crc32c_of_the_standard_check_string():
    assert crc32c(b"123456789") == 0xE3069283  # RFC 3720, appendix B.4 and the catalogue of CRCs


@given(st.binary(max_size=300))
@settings(deadline=None)  # the first call compiles
def test_checksums_equal_those_computed_bit_by_bit(data):
    assert crc32c(data) == records.crc32c(data)
    assert struct.pack("<I", masked_crc(data)) == records.masked(data)


@given(
    integers=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5),
    floats=st.lists(st.floats(width=32, allow_nan=False), max_size=5),
    strings=st.lists(st.binary(max_size=20), max_size=4),
    name=st.text(min_size=1, max_size=8),
)
@settings(max_examples=50, deadline=None)
def test_gives_back_every_kind_of_feature(tmp_path_factory, integers, floats, strings, name):
    payload = records.sequence_example(
        {"integers": records.integer_feature(*integers), "floats": records.float_feature(np.array(floats))},
        {name: [records.bytes_feature(*strings), records.bytes_feature()]},
    )
    path = records.write_records(tmp_path_factory.mktemp("r") / "train.tfrecord", records.record(payload))
    example = read_record(path, 0, 0)
    assert np.asarray(example.context["integers"]).tolist() == integers
    np.testing.assert_array_equal(example.context["floats"], np.array(floats, np.float32))
    assert [list(feature) for feature in example.steps[name]] == [strings, []]


def three(path: Path) -> Path:
    rng = np.random.default_rng(0)
    made = [records.trajectory_record(rng.random((2, 3, 2)), [5, 5, 3]) for _ in range(3)]
    return records.write_records(path / "train.tfrecord", *made)


def test_offsets_of_every_record(tmp_path):
    path = three(tmp_path)
    offsets = record_offsets(path)
    assert len(offsets) == 3
    assert offsets == [i * (path.stat().st_size // 3) for i in range(3)]


@given(cut=st.integers(1, 10_000))
@settings(max_examples=60, deadline=None)
def test_a_file_cut_short_is_refused_by_name(tmp_path_factory, cut):
    path = three(tmp_path_factory.mktemp("cut"))
    whole = path.read_bytes()
    kept = len(whole) - 1 - cut % (len(whole) - 1)
    path.write_bytes(whole[:kept])
    third = len(whole) // 3
    if kept % third == 0:
        assert len(record_offsets(path)) == kept // third  # Nothing tells it from a shorter file.
        return
    with pytest.raises(DataError, match=r"train\.tfrecord: record \d"):
        record_offsets(path)


@given(place=st.integers(0, 10_000), bit=st.integers(0, 7))
@settings(max_examples=100, deadline=None)
def test_every_flipped_bit_is_detected(tmp_path_factory, place, bit):
    path = three(tmp_path_factory.mktemp("flip"))
    data = bytearray(path.read_bytes())
    data[place % len(data)] ^= 1 << bit
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"train\.tfrecord: record \d"):
        [read_record(path, offset, index) for index, offset in enumerate(record_offsets(path))]
