import zlib

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.compression import FILTERS, write_compressed


def stored_chunks(dataset) -> list[bytes]:
    """Shuffled, as they are before compression, whose bytes depend on the library."""
    places = range(0, len(dataset), dataset.chunks[0])
    return [zlib.decompress(dataset.id.read_direct_chunk((place, 0))[1]) for place in places]


@given(
    length=st.integers(1, 40), width=st.integers(1, 5), rows=st.integers(1, 40), threads=st.integers(1, 3),
    kind=st.sampled_from(["<f4", "<f8", "<i2"]), seed=st.integers(0, 99),
)  # fmt: skip
@settings(max_examples=60)
def test_chunks_are_those_that_hdf5_writes(tmp_path_factory, length, width, rows, threads, kind, seed):
    values = np.random.default_rng(seed).integers(0, 1000, (length, width)).astype(kind)
    rows = min(rows, length)
    with h5py.File(tmp_path_factory.mktemp("chunks") / "file.h5", "w") as file:
        write_compressed(file, "ours", values, rows, threads)
        file.create_dataset("theirs", data=values, chunks=(rows, width), **FILTERS)
        np.testing.assert_array_equal(file["ours"][:], values)
        assert file["ours"].dtype == values.dtype
        assert file["ours"].chunks == file["theirs"].chunks
        assert stored_chunks(file["ours"]) == stored_chunks(file["theirs"])


def test_values_that_are_not_contiguous_are_written(tmp_path):
    values = np.arange(60.0).reshape(3, 20).T
    with h5py.File(tmp_path / "file.h5", "w") as file:
        write_compressed(file, "ours", values, 6)
        np.testing.assert_array_equal(file["ours"][:], values)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_number_of_threads_does_not_matter(tmp_path, threads):
    values = np.random.default_rng(0).random((200, 3), dtype=np.float32)
    for name, count in (("one.h5", 1), ("many.h5", threads)):
        with h5py.File(tmp_path / name, "w", libver=("earliest", "v108")) as file:
            write_compressed(file, "position", values, 7, count)
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "many.h5").read_bytes()
