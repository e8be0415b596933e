import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.sim.mpm.mls_mpm_2d import Stepper2d
from nmpm.sim.mpm.solids import Goop
from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles

GOOP = Goop(density=1000.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)
LOW, SIZE, CELLS = 0.1, 0.025, 32
DT = 2e-4


def make_grid(gravity=(0.0, 0.0), friction=0.5):
    return MpmGrid(np.full(2, LOW), SIZE, (CELLS, CELLS), friction, np.array(gravity))


def make_state(position, velocity):
    return MpmParticles(position, velocity, ((GOOP, len(position)),), (SIZE / 2) ** 2)


def make_block(rng, side=12, low=0.4):
    lattice = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    return low + SIZE / 2 * (lattice + rng.uniform(-0.2, 0.2, lattice.shape))


def momentum(state):
    return (state.mass[:, None] * state.velocity).sum(axis=0)


def angular_momentum(state):
    """Of the particles, and of the affine motion that each carries."""
    x, v, c = state.position, state.velocity, state.gradient
    carried = SIZE**2 / 4 * (c[:, 1, 0] - c[:, 0, 1])
    return (state.mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + carried)).sum()


def test_momentum_and_angular_momentum_are_conserved_away_from_walls():
    rng = np.random.default_rng(0)
    position = make_block(rng)
    state = make_state(position, rng.normal(size=position.shape))
    before, turning = momentum(state), angular_momentum(state)
    stepper = Stepper2d(make_grid(), DT)
    for _ in range(50):
        stepper.step(state)
    assert np.abs(state.stress).max() > 100, "The test should strain the material."
    np.testing.assert_allclose(momentum(state), before, rtol=1e-10, atol=1e-10 * state.mass.sum())
    assert angular_momentum(state) == pytest.approx(turning, rel=1e-9, abs=1e-9 * state.mass.sum())


def test_the_grid_receives_the_mass_of_the_particles():
    position = make_block(np.random.default_rng(0))
    state = make_state(position, np.zeros_like(position))
    stepper = Stepper2d(make_grid(), DT)
    stepper.step(state)
    assert stepper._nodes[..., 0].sum() == pytest.approx(len(position) * GOOP.density * (SIZE / 2) ** 2)


def test_gravity_changes_momentum_by_its_impulse():
    position = make_block(np.random.default_rng(0))
    state = make_state(position, np.zeros_like(position))
    stepper = Stepper2d(make_grid(gravity=(1.0, -9.81)), DT)
    for _ in range(100):
        stepper.step(state)
    expected = state.mass.sum() * 100 * DT * np.array([1.0, -9.81])
    np.testing.assert_allclose(momentum(state), expected, rtol=1e-10)


def test_a_rotating_block_keeps_its_shape():
    """Rigid motion strains only through the substep's finite length."""
    position = make_block(np.random.default_rng(0))
    arms = position - position.mean(axis=0)
    state = make_state(position, 5.0 * np.stack([-arms[:, 1], arms[:, 0]], -1))
    state.gradient[:] = 5.0 * np.array([[0.0, -1.0], [1.0, 0.0]])
    stepper = Stepper2d(make_grid(), DT)
    for _ in range(int(np.pi / 5.0 / DT)):
        stepper.step(state)
    half_turned = state.position - state.position.mean(axis=0)
    np.testing.assert_allclose(half_turned, -arms, atol=0.1 * SIZE)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 30.0), st.floats(0.0, 2.0))
def test_no_particle_leaves_the_box_or_needs_clamping(seed, speed, friction):
    rng = np.random.default_rng(seed)
    inset = SIZE / 4
    position = np.concatenate([make_block(rng, 6, LOW + inset), make_block(rng, 6, LOW + CELLS * SIZE - 3 * SIZE)])
    state = make_state(position, rng.uniform(-speed, speed, position.shape))
    stepper = Stepper2d(make_grid((0.0, -9.81), friction), DT)
    for _ in range(60):
        stepper.step(state)
        assert np.all((state.position > LOW) & (state.position < LOW + CELLS * SIZE))
    assert stepper.held_back == 0


def test_walls_never_pull():
    position = make_block(np.random.default_rng(0), low=LOW + SIZE / 4)
    state = make_state(position, np.tile([0.0, 2.0], (len(position), 1)))
    stepper = Stepper2d(make_grid(), DT)
    for _ in range(200):
        stepper.step(state)
    np.testing.assert_allclose(state.velocity, np.tile([0.0, 2.0], (len(position), 1)), atol=1e-9)


@pytest.mark.parametrize(("friction", "expected"), [(0.0, 1.0), (0.3, 1.0 - 0.3 * 9.81 * 0.1), (5.0, 0.0)])
def test_a_thin_layer_slides_to_a_stop_by_coulomb_friction(friction, expected):
    columns = int(0.5 / (SIZE / 2))
    lattice = np.stack(np.meshgrid(np.arange(columns), np.arange(2)), -1).reshape(-1, 2)
    position = np.array([LOW + 3 * SIZE, LOW + 0.75 * SIZE]) + SIZE / 2 * lattice
    state = make_state(position, np.tile([1.0, 0.0], (len(position), 1)))
    stepper = Stepper2d(make_grid((0.0, -9.81), friction), DT)
    for _ in range(500):
        stepper.step(state)
    assert momentum(state)[0] / state.mass.sum() == pytest.approx(expected, abs=0.1)


def test_non_finite_states_are_detected():
    position = make_block(np.random.default_rng(0))
    state = make_state(position, np.zeros_like(position))
    state.strain[17, 0] = np.nan
    with pytest.raises(FloatingPointError):
        Stepper2d(make_grid(), DT).step(state)
