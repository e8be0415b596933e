import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.sim.mpm.water import Water

WATER = Water(density=1000.0, bulk_modulus=7e4)


def respond(water, gradient, volume=1.0, dt=1e-4):
    """Volume and stress of one particle after a substep."""
    gradient = np.array([gradient], dtype=float)
    dim = gradient.shape[1]
    strain, stress = np.array([[volume]]), np.full((1, dim * (dim + 1) // 2), np.nan)
    water.respond(strain, gradient, stress, dt)
    return strain[0, 0], stress[0]


def matrices(dim):
    return st.lists(st.floats(-300, 300), min_size=dim**2, max_size=dim**2).map(lambda v: np.reshape(v, (dim, dim)))


@pytest.mark.parametrize("dim", [2, 3])
def test_is_stress_free_at_rest(dim):
    volume, stress = respond(WATER, np.zeros((dim, dim)))
    assert volume == 1
    np.testing.assert_array_equal(stress, 0)
    assert WATER.rest(dim) == (1.0,)


@given(st.sampled_from([2, 3]).flatmap(matrices), st.floats(0.7, 1.4))
@settings(deadline=None)  # the first call compiles
def test_only_divergence_changes_volume_and_pressure_is_the_same_all_round(gradient, volume):
    after, stress = respond(WATER, gradient, volume)
    assert after == pytest.approx(volume * (1 + 1e-4 * np.trace(gradient)))
    expected = -after * 7e4 / 7 * (after**-7 - 1) * np.eye(len(gradient))
    np.testing.assert_allclose(stress, expected[np.triu_indices(len(gradient))], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("exponent", [-1.0, 1.0, 7.0])
def test_stiffness_at_rest_is_the_bulk_modulus(exponent):
    water = Water(density=1000.0, bulk_modulus=7e4, exponent=exponent)
    assert (water.pressure(1 - 1e-5) - water.pressure(1 + 1e-5)) / 2e-5 == pytest.approx(7e4, rel=1e-6)
    assert water.wave_speed == pytest.approx(math.sqrt(70))


@pytest.mark.parametrize("tension", [0.0, 0.3, 1.0])
def test_keeps_the_stated_share_of_tension(tension):
    water = Water(density=1000.0, bulk_modulus=7e4, tension=tension)
    assert water.pressure(1.2) == pytest.approx(tension * WATER.pressure(1.2))
    assert water.pressure(0.9) == WATER.pressure(0.9) > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_viscosity_resists_shear_and_not_rotation(dim):
    viscous = Water(density=1000.0, bulk_modulus=7e4, viscosity=3.0)
    gradient = np.zeros((dim, dim))
    gradient[0, 1] = 5.0
    _, stress = respond(viscous, gradient)
    assert stress[1] == pytest.approx(15.0)
    assert np.delete(stress, 1) == pytest.approx(0.0)
    _, stress = respond(viscous, gradient - gradient.T)
    np.testing.assert_allclose(stress, 0.0, atol=1e-12)


def test_a_nan_volume_stays_nan():
    volume, stress = respond(WATER, np.full((2, 2), np.nan))
    assert math.isnan(volume)
    assert math.isnan(stress[0])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("density", 0),
        ("bulk_modulus", math.inf),
        ("exponent", 0),
        ("exponent", -2),
        ("viscosity", -1),
        ("tension", 1.1),
    ],
)
def test_refuses_parameters_out_of_range(key, value):
    with pytest.raises(ConfigError, match=rf"water\.{key}"):
        Water(**{**WATER.to_dict(), key: value})
