import math

import pytest

from nmpm.zoo.queue.validations import ends_lowest, lowest_errors, lowest_mse

EARLIER = [[1.0, 1, 0.5], [2.0, 2, 0.2], [3.0, 3, 0.3], [4.0, 4, 0.1]]
NOISY = [[1.0, 1, 0.1, 0.09], [2.0, 2, 0.4, 0.05]]
STEADY = [[1.0, 1, 0.3, 0.06], [2.0, 2, 0.2, 0.04]]
LUCKY = [[float(at), at, 10 * error, error] for at, error in enumerate((0.9, 0.3, 0.8, 0.6, 0.5, 0.4, 0.4, 0.4))]


@pytest.mark.parametrize(
    ("curves", "expected"),
    [
        ([NOISY, STEADY], [0.07, 0.05]),  # by the overall error
        ([EARLIER[:2], STEADY, NOISY], [0.35, 0.25, 0.25]),  # by the MSE where the overall error is lowest
        ([EARLIER, EARLIER[:1]], [0.2, math.inf]),  # a single one may be low by chance
        ([EARLIER[:2], EARLIER[1:2]], [0.35, 0.2]),  # but so may two
        ([[*EARLIER, *STEADY], [*NOISY, *NOISY]], [0.05, 0.19 / 3]),  # a training that an earlier version began
        ([STEADY, []], [0.05, math.inf]),
        ([[], EARLIER], [math.inf, 0.2]),
        ([LUCKY], [0.4]),
        ([[[0.0, 0, math.nan, math.nan], *LUCKY]], [0.4]),
        ([[[0.0, 0, math.nan, math.nan]], STEADY], [math.inf, 0.05]),
        ([[*LUCKY, [8.0, 8, 1.0, 0.1]]], [0.3]),  # at the end, too, a low one counts for a third
    ],
)
def test_curves_are_compared_where_neighbouring_validations_are_lowest_by_what_all_state(curves, expected):
    assert lowest_errors(*curves) == pytest.approx(expected)


def test_the_mse_is_that_where_the_overall_error_is_lowest():
    assert lowest_mse(LUCKY) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        (LUCKY, True),  # the lowest single validation is chance
        ([*LUCKY[:3], [3.0, 3, 3.0, 0.3], *LUCKY[3:]], True),
        ([*LUCKY, [8.0, 8, 9.0, 0.9], [9.0, 9, 9.0, 0.9]], False),  # it has become worse
        (STEADY, False),  # the last is the lowest, and kept
        (EARLIER[:1], False),
        ([*LUCKY, [8.0, 8, math.nan, math.nan]], False),
        ([[8.0, 8, math.nan, math.nan]], False),
        ([point[:3] for point in LUCKY], True),  # of earlier versions
    ],
)
def test_the_last_weights_are_better_than_those_of_a_low_validation_among_high_ones(curve, expected):
    assert ends_lowest(curve) is expected
