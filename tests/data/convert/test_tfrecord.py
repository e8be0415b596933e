import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert.deepmind import crc32c, masked_crc, read_record, record_offsets
from nmpm.errors import DataError
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
