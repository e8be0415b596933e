import math

import pytest

from nmpm.zoo.queue.validations import lowest_errors

EARLIER = [[1.0, 1, 0.5], [2.0, 2, 0.2], [3.0, 3, 0.3]]
NOISY = [[1.0, 1, 0.1, 0.09], [2.0, 2, 0.4, 0.05]]
STEADY = [[1.0, 1, 0.3, 0.06], [2.0, 2, 0.2, 0.04]]


@pytest.mark.parametrize(
    ("curves", "expected"),
    [
        ([NOISY, STEADY], [0.05, 0.04]),  # by the overall error
        ([EARLIER, STEADY, NOISY], [0.2, 0.2, 0.4]),  # by the MSE of the weights that were kept
        ([EARLIER, EARLIER[:1]], [0.2, 0.5]),
        ([[*EARLIER, *STEADY], NOISY], [0.04, 0.05]),  # a training that an earlier version began
        ([STEADY, []], [0.04, math.inf]),
        ([[], EARLIER], [math.inf, 0.2]),
    ],
)
def test_the_weights_that_were_kept_are_compared_by_what_all_curves_state(curves, expected):
    assert lowest_errors(*curves) == expected
