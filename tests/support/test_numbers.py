"""Numbers among values from files."""

import pytest

from nmpm._support.plain_data import is_finite


@pytest.mark.parametrize("value", [10**400, -(10**400), float("inf"), float("nan"), True, "1", None])
def test_what_is_no_finite_number_in_float64_is_told(value):
    assert not is_finite(value)


@pytest.mark.parametrize("value", [0, -1.5, 10**300, 1.7976931348623157e308])
def test_finite_numbers_of_any_size(value):
    assert is_finite(value)
