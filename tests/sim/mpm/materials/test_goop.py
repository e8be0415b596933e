import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.sim.mpm.solids import Goop

GOOP = Goop(density=1000.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)


def respond(goop, gradient, strain=(1.0, 0.0, 1.0), dt=1e-4, substeps=1):
    """Strain and stress of one particle after substeps with a constant velocity gradient."""
    state, stress = np.array([strain]), np.zeros((1, 3))
    for _ in range(substeps):
        goop.respond(state, np.array([gradient], dtype=float), stress, dt)
    return state[0], stress[0]


def area(strain):
    return math.sqrt(strain[0] * strain[2] - strain[1] ** 2)


def test_is_stress_free_at_rest():
    strain, stress = respond(GOOP, [[0, 0], [0, 0]])
    np.testing.assert_array_equal(strain, [1, 0, 1])
    np.testing.assert_array_equal(stress, [0, 0, 0])


@pytest.mark.parametrize("rate", [1.0, 10.0, 50.0])
def test_steady_shear_has_the_stress_of_a_bingham_fluid(rate):
    _, stress = respond(GOOP, [[0, rate], [0, 0]], dt=1e-5, substeps=5000)
    assert math.hypot(stress[1], (stress[0] - stress[2]) / 2) == pytest.approx(200 + 60 * rate, rel=0.02)


def test_slow_shear_below_the_yield_stress_is_elastic():
    shear = 0.5 * GOOP.yield_stress / GOOP.shear_modulus
    _, stress = respond(GOOP, [[0, 1.0], [0, 0]], dt=shear / 100, substeps=100)
    assert stress[1] == pytest.approx(GOOP.shear_modulus * shear, rel=1e-3)
    _, stress = respond(GOOP, [[0, -1.0], [0, 0]], dt=shear / 100, substeps=100)
    assert stress[1] == pytest.approx(-GOOP.shear_modulus * shear, rel=1e-3)


def test_a_change_of_area_is_kept():
    strain, stress = respond(GOOP, [[-1.0, 0], [0, -1.0]], dt=1e-4, substeps=100)
    assert area(strain) == pytest.approx((1 - 1e-4) ** 200)
    assert stress == pytest.approx([GOOP.bulk_modulus * math.log(area(strain)), 0, stress[0]])


def test_stress_above_the_yield_stress_relaxes_at_the_rate_of_its_viscosity():
    stretch = math.exp(0.02)
    elastic = 2 * GOOP.shear_modulus * 0.01
    _, stress = respond(GOOP, [[0, 0], [0, 0]], strain=(stretch, 0.0, 1 / stretch), dt=2e-4)
    decay = math.exp(-GOOP.shear_modulus * 2e-4 / GOOP.viscosity)
    assert stress[0] == pytest.approx(200 + (elastic - 200) * decay)


gradients = st.lists(st.floats(-300, 300), min_size=4, max_size=4).map(lambda v: np.reshape(v, (2, 2)))
strains = st.tuples(st.floats(0.7, 1.4), st.floats(-0.3, 0.3), st.floats(0.7, 1.4))


@given(gradients, strains)
@settings(deadline=None)  # the first call compiles
def test_flow_keeps_area_and_stress_follows_strain(gradient, strain):
    after, stress = respond(GOOP, gradient, strain)
    stretch = np.eye(2) + 1e-4 * gradient
    assert area(after) == pytest.approx(area(strain) * np.linalg.det(stretch))
    trial = stretch @ np.array([[strain[0], strain[1]], [strain[1], strain[2]]]) @ stretch.T
    shear = 2 * GOOP.shear_modulus * abs(np.diff(np.log(np.linalg.eigvalsh(trial)))[0]) / 4
    limit = max(min(shear, 200), 200 + (shear - 200) * math.exp(-GOOP.shear_modulus * 1e-4 / 60))
    assert math.hypot(stress[1], (stress[0] - stress[2]) / 2) == pytest.approx(min(shear, limit), rel=1e-6, abs=1e-6)
    assert (stress[0] + stress[2]) / 2 == pytest.approx(GOOP.bulk_modulus * math.log(area(after)), rel=1e-6, abs=1e-6)


@given(gradients, strains, st.floats(0, 2 * math.pi))
@settings(deadline=None)  # the first call compiles
def test_the_response_turns_with_the_frame(gradient, strain, angle):
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def turned(tensor):
        full = turn @ np.array([[tensor[0], tensor[1]], [tensor[1], tensor[2]]]) @ turn.T
        return full[0, 0], full[0, 1], full[1, 1]

    _, stress = respond(GOOP, gradient, strain)
    _, again = respond(GOOP, turn @ gradient @ turn.T, turned(strain))
    assert again == pytest.approx(turned(stress), rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(
    ("key", "value"),
    [("density", 0), ("young", -1), ("viscosity", 0), ("yield_stress", -1), ("poisson", 0.5), ("young", math.nan)],
)
def test_refuses_parameters_out_of_range(key, value):
    with pytest.raises(ConfigError, match=rf"goop\.{key}"):
        Goop(**{**GOOP.to_dict(), key: value})
