"""Runs that nobody has split."""

import pytest

from nmpm.data.convert.base import split_runs


@pytest.mark.parametrize(
    ("count", "sizes"),
    [(0, {}), (2, {"train": 2}), (3, {"train": 1, "valid": 1, "test": 1}), (40, {"train": 32, "valid": 4, "test": 4})],
)
def test_the_last_tenths_of_the_runs_test_and_validate(count, sizes):
    parts = split_runs(count)
    assert {split: len(part) for split, part in parts.items()} == sizes
    assert sorted(run for part in parts.values() for run in part) == list(range(count))
