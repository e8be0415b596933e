"""Constitutive models of single particles against closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.sim.mpm.materials import Goop, Sand, Water

GOOP = Goop(density=1000.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)
SAND = Sand(density=1000.0, young=3.5e5, poisson=0.3, friction_angle=30.0)
WATER = Water(density=1000.0, bulk_modulus=7e4)


def respond(material, gradient, strain=(1.0, 0.0, 1.0), dt=1e-4, substeps=1):
    """Strain and stress of one particle after substeps with a constant velocity gradient."""
    gradient = np.array([gradient], dtype=float)
    dim = gradient.shape[1]
    state, stress = np.array([strain], float), np.full((1, dim * (dim + 1) // 2), np.nan)
    for _ in range(substeps):
        material.respond(state, gradient, stress, dt)
    return state[0], stress[0]


def area(strain):
    return math.sqrt(strain[0] * strain[2] - strain[1] ** 2)


def matrices(dim):
    return st.lists(st.floats(-300, 300), min_size=dim**2, max_size=dim**2).map(lambda v: np.reshape(v, (dim, dim)))


strains = st.tuples(st.floats(0.8, 1.1), st.floats(-0.2, 0.2), st.floats(0.8, 1.1))


@pytest.mark.parametrize("material", [GOOP, SAND, WATER], ids=lambda m: m.name)
@pytest.mark.parametrize("dim", [2, 3])
def test_is_stress_free_at_rest(material, dim):
    if dim == 3 and material is not WATER:
        with pytest.raises(ConfigError, match="in two dimensions, not in 3"):
            material.rest(3)
        return
    strain, stress = respond(material, np.zeros((dim, dim)), material.rest(dim))
    np.testing.assert_array_equal(strain, material.rest(dim))
    np.testing.assert_array_equal(stress, 0)


@pytest.mark.parametrize("solid", [GOOP, SAND], ids=lambda m: m.name)
def test_small_strains_below_yield_give_hookes_law_and_are_recovered(solid):
    """Plane strain, ε = the gradient's symmetric part × 1e-4: (λ + μ) tr ε · I + 2 μ dev ε; rotation adds nothing."""
    gradient = np.array([[-2.0, 0.7], [-0.3, -1.6]])
    strain = 1e-4 * (gradient + gradient.T) / 2
    spherical = np.trace(strain) / 2 * np.eye(2)
    hooke = (2 * solid.bulk_modulus * spherical + 2 * solid.shear_modulus * (strain - spherical)).ravel()[[0, 1, 3]]
    state, stress = respond(solid, gradient, dt=1e-5, substeps=10)
    assert stress == pytest.approx(hooke, rel=2e-3)
    _, stress = respond(solid, -gradient, state, dt=1e-5, substeps=6)
    assert stress == pytest.approx(0.4 * hooke, rel=2e-3)


@pytest.mark.parametrize("rate", [1.0, 10.0, 50.0])
def test_steady_shear_has_the_stress_of_a_bingham_fluid(rate):
    _, stress = respond(GOOP, [[0, rate], [0, 0]], dt=1e-5, substeps=5000)
    assert math.hypot(stress[1], (stress[0] - stress[2]) / 2) == pytest.approx(200 + 60 * rate, rel=0.02)


@given(matrices(2), strains)
@settings(deadline=None, max_examples=40)  # the first call compiles
def test_flow_keeps_area_and_stress_follows_strain(gradient, strain):
    after, stress = respond(GOOP, gradient, strain)
    stretch = np.eye(2) + 1e-4 * gradient
    assert area(after) == pytest.approx(area(strain) * np.linalg.det(stretch))
    trial = stretch @ np.array([[strain[0], strain[1]], [strain[1], strain[2]]]) @ stretch.T
    shear = 2 * GOOP.shear_modulus * abs(np.diff(np.log(np.linalg.eigvalsh(trial)))[0]) / 4
    limit = max(min(shear, 200), 200 + (shear - 200) * math.exp(-GOOP.shear_modulus * 1e-4 / 60))
    assert math.hypot(stress[1], (stress[0] - stress[2]) / 2) == pytest.approx(min(shear, limit), rel=1e-6, abs=1e-6)
    assert (stress[0] + stress[2]) / 2 == pytest.approx(GOOP.bulk_modulus * math.log(area(after)), rel=1e-6, abs=1e-6)


@given(matrices(2), strains, st.floats(0, 2 * math.pi))
@settings(deadline=None, max_examples=40)  # the first call compiles
def test_the_response_turns_with_the_frame(gradient, strain, angle):
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def turned(tensor):
        full = turn @ np.array([[tensor[0], tensor[1]], [tensor[1], tensor[2]]]) @ turn.T
        return full[0, 0], full[0, 1], full[1, 1]

    _, stress = respond(GOOP, gradient, strain)
    _, again = respond(GOOP, turn @ gradient @ turn.T, turned(strain))
    assert again == pytest.approx(turned(stress), rel=1e-6, abs=1e-3)


@given(matrices(2), strains, st.floats(0, 60))
@settings(deadline=None, max_examples=40)  # the first call compiles
def test_shear_stress_is_bounded_by_friction_and_sand_never_pulls(gradient, strain, angle):
    after, stress = respond(Sand(1000.0, 3.5e5, 0.3, angle), gradient, strain)
    pressure = -(stress[0] + stress[2]) / 2
    assert pressure >= 0
    shear = math.hypot(stress[1], (stress[0] - stress[2]) / 2)
    assert shear <= math.sin(math.radians(angle)) * pressure * (1 + 1e-9) + 1e-6
    # Neither sliding nor parting makes or loses volume.
    stretch = np.eye(2) + 1e-4 * gradient
    assert area(after) == pytest.approx(area(strain) * np.linalg.det(stretch))


def test_steady_shear_of_sand_has_the_ratio_of_its_friction_angle():
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


@given(st.sampled_from([2, 3]).flatmap(matrices), st.floats(0.7, 1.4))
@settings(deadline=None, max_examples=40)  # the first call compiles
def test_only_divergence_changes_volume_and_pressure_is_the_same_all_round(gradient, volume):
    (after,), stress = respond(WATER, gradient, [volume])
    assert after == pytest.approx(volume * (1 + 1e-4 * np.trace(gradient)))
    expected = -after * 7e4 / 7 * (after**-7 - 1) * np.eye(len(gradient))
    np.testing.assert_allclose(stress, expected[np.triu_indices(len(gradient))], rtol=1e-9, atol=1e-6)


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
    _, stress = respond(viscous, gradient, [1.0])
    assert stress[1] == pytest.approx(15.0)
    assert np.delete(stress, 1) == pytest.approx(0.0)
    _, stress = respond(viscous, gradient - gradient.T, [1.0])
    np.testing.assert_allclose(stress, 0.0, atol=1e-12)


def test_a_nan_volume_stays_nan():
    (volume,), stress = respond(WATER, np.full((2, 2), np.nan), [1.0])
    assert math.isnan(volume)
    assert math.isnan(stress[0])


@pytest.mark.parametrize(
    ("material", "key", "value"),
    [
        (GOOP, "young", math.nan), (GOOP, "poisson", 0.5), (SAND, "friction_angle", 90), (WATER, "exponent", 0),
        (WATER, "tension", 1.1),
    ],
)  # fmt: skip
def test_parameters_out_of_range_are_named(material, key, value):
    with pytest.raises(ConfigError, match=rf"{material.name}\.{key}"):
        dataclasses.replace(material, **{key: value})
