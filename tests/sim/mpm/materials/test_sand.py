import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.sim.mpm.solids import Sand

SAND = Sand(density=1000.0, young=3.5e5, poisson=0.3, friction_angle=30.0)


def respond(sand, gradient, strain=(1.0, 0.0, 1.0), dt=1e-4, substeps=1):
    """Strain and stress of one particle after substeps with a constant velocity gradient."""
    state, stress = np.array([strain]), np.full((1, 3), np.nan)
    for _ in range(substeps):
        sand.respond(state, np.array([gradient], dtype=float), stress, dt)
    return state[0], stress[0]


def area(strain):
    return math.sqrt(strain[0] * strain[2] - strain[1] ** 2)


gradients = st.lists(st.floats(-300, 300), min_size=4, max_size=4).map(lambda v: np.reshape(v, (2, 2)))
strains = st.tuples(st.floats(0.8, 1.1), st.floats(-0.2, 0.2), st.floats(0.8, 1.1))


@given(gradients, strains, st.floats(0, 60))
@settings(deadline=None)  # the first call compiles
def test_shear_stress_is_bounded_by_friction_and_sand_never_pulls(gradient, strain, angle):
    after, stress = respond(Sand(1000.0, 3.5e5, 0.3, angle), gradient, strain)
    pressure = -(stress[0] + stress[2]) / 2
    assert pressure >= 0
    shear = math.hypot(stress[1], (stress[0] - stress[2]) / 2)
    assert shear <= math.sin(math.radians(angle)) * pressure * (1 + 1e-9) + 1e-6
    # Neither sliding nor parting makes or loses volume.
    stretch = np.eye(2) + 1e-4 * gradient
    assert area(after) == pytest.approx(area(strain) * np.linalg.det(stretch))


def test_is_elastic_within_the_friction_cone():
    pressed = (0.98, 0.0, 0.98)
    _, stress = respond(SAND, [[0, 1.0], [0, 0]], pressed, dt=1e-5, substeps=100)
    assert stress[1] == pytest.approx(SAND.shear_modulus * 1e-3, rel=0.01)
    assert stress[0] + stress[2] == pytest.approx(2 * SAND.bulk_modulus * math.log(0.98), rel=1e-3)


def test_steady_shear_has_the_ratio_of_its_friction_angle():
    _, stress = respond(SAND, [[0, 5.0], [0, 0]], (0.98, 0.0, 0.98), dt=1e-4, substeps=1000)
    pressure = -(stress[0] + stress[2]) / 2
    assert math.hypot(stress[1], (stress[0] - stress[2]) / 2) / pressure == pytest.approx(0.5)
    assert pressure == pytest.approx(-SAND.bulk_modulus * math.log(0.98), rel=1e-6)


def test_volume_gained_while_apart_must_be_lost_before_grains_touch():
    open_up, close = [[10.0, 0], [0, 10.0]], [[-10.0, 0], [0, -10.0]]
    strain, stress = respond(SAND, open_up, substeps=100)
    np.testing.assert_array_equal(stress, 0)
    strain, stress = respond(SAND, close, strain, substeps=95)
    np.testing.assert_array_equal(stress, 0)
    _, stress = respond(SAND, close, strain, substeps=10)
    assert stress[0] < 0


@pytest.mark.parametrize(
    ("key", "value"),
    [("density", 0), ("young", math.nan), ("poisson", 0.5), ("friction_angle", 90), ("friction_angle", -1)],
)
def test_refuses_parameters_out_of_range(key, value):
    with pytest.raises(ConfigError, match=rf"sand\.{key}"):
        Sand(**{**SAND.to_dict(), key: value})


def test_is_implemented_in_two_dimensions_only():
    with pytest.raises(ConfigError, match="in 3"):
        SAND.rest(3)
