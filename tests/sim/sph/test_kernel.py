import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from nmpm.sim.sph.sums import NORM, SUPPORT, slope, weight


def test_integrates_to_one_over_the_plane():
    integral = sum(quad(lambda q: 2 * math.pi * q * NORM * weight(q), n, n + 1)[0] for n in range(3))
    assert integral == pytest.approx(1.0, abs=1e-12)


def test_known_values():
    assert weight(0.0) == 3**5 - 6 * 2**5 + 15
    assert weight(1.0) == 2**5 - 6
    assert weight(2.0) == 1.0
    assert slope(0.0) == 0.0


@given(st.floats(1e-3, 4.0))
@settings(deadline=None)  # the first call compiles
def test_slope_is_the_derivative_and_never_points_outwards(q):
    central = (weight(q + 1e-5) - weight(q - 1e-5)) / 2e-5
    assert slope(q) == pytest.approx(central, abs=1e-6)
    assert slope(q) <= 1e-12


@given(st.floats(SUPPORT, 1e6))
@settings(deadline=None)  # the first call compiles
def test_is_zero_beyond_its_support(q):
    assert weight(q) == 0.0
    assert slope(q) == 0.0


def test_a_lattice_of_one_smoothing_length_sums_to_one():
    nodes = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), -1).reshape(-1, 2)
    total = sum(NORM * weight(math.hypot(*node)) for node in nodes)
    assert total == pytest.approx(1.0, abs=1e-3)
