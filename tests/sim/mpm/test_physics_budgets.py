"""Free fall, and what momentum and mass must add up to, for every material and all of them together."""

import numpy as np
import pytest
from columns import at_rest, lattice, run, tank
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.sim.mpm.solids import Goop, Sand
from nmpm.sim.mpm.stepper import Walls
from nmpm.sim.mpm.water import Water

SIZE = 0.025
WATER = Water(density=1000.0, bulk_modulus=7e4)
SAND = Sand(density=1600.0, young=3.5e5, poisson=0.3, friction_angle=30.0)
GOOP = Goop(density=1200.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)
MATERIALS = [WATER, SAND, GOOP]


def momentum(state):
    return (state.mass[:, None] * state.velocity).sum(axis=0)


def mixed(blocks, size=SIZE):
    """A block of each material, given by their lower corners."""
    parts = [lattice(low, np.add(low, 0.15), size / 2) for low in blocks]
    return at_rest(np.concatenate(parts), tuple(zip(MATERIALS, map(len, parts), strict=True)), size)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_free_fall_is_exact(material):
    position = lattice((0.3, 0.5), (0.5, 0.7), SIZE / 2)
    state = at_rest(position, ((material, len(position)),), SIZE)
    state.velocity[:] = thrown = np.array([0.7, 0.5])
    stepper = tank(1.0, 1.0, SIZE, 30.0)
    time = run(stepper, state, 0.2)
    # Gravity acts at the start of each substep, so that the fall runs ahead by half a substep's worth.
    fallen = np.array([0.0, -9.81]) * time * (time + stepper.dt) / 2
    np.testing.assert_allclose(state.position, position + thrown * time + fallen, atol=1e-12)


def test_momentum_grows_by_gravitys_impulse_while_materials_collide():
    state = mixed([(0.2, 0.7), (0.4, 0.7), (0.3, 0.9)])
    state.velocity[:] = np.repeat([[1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]], len(state.mass) // 3, axis=0)
    before = momentum(state)
    time = run(tank(1.0, 1.5, SIZE, 30.0), state, 0.15)
    assert np.abs(state.stress).max() > 100, "They should collide."
    expected = before + state.mass.sum() * time * np.array([0.0, -9.81])
    np.testing.assert_allclose(momentum(state), expected, rtol=1e-10)


def test_the_grid_holds_the_mass_of_every_material():
    state = mixed([(0.0, 0.0), (0.15, 0.0), (0.5, 0.3)])
    stepper = tank(1.0, 1.0, SIZE, 30.0)
    for _ in range(100):
        stepper.step(state)
        assert stepper._nodes[..., 0].sum() == pytest.approx(state.mass.sum(), rel=1e-12)
    assert state.mass.sum() == pytest.approx(0.15**2 * (1000 + 1600 + 1200))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 10.0), st.floats(0.0, 1.0), st.sampled_from(list(Walls)))
def test_nothing_leaves_the_box_whatever_its_walls(seed, speed, friction, walls):
    rng = np.random.default_rng(seed)
    state = mixed([(0.0, 0.0), (0.4, 0.01), (0.2, 0.4)])
    state.velocity[:] = rng.uniform(-speed, speed, state.velocity.shape)
    stepper = tank(0.6, 0.6, SIZE, 60.0, friction=friction, walls=walls)
    low, high = stepper.grid.low, stepper.grid.low + SIZE * np.array(stepper.grid.shape)
    for _ in range(150):
        stepper.step(state)
        assert np.all((state.position > low) & (state.position < high))
    assert stepper.held_back == 0


@pytest.mark.parametrize(("walls", "speed"), [(Walls.SEPARATE, 1.0), (Walls.SLIP, 0.0), (Walls.OPEN_CORNERS, 0.0)])
def test_only_walls_that_hold_stop_material_that_leaves(walls, speed):
    position = lattice((0.2, 0.0), (0.4, SIZE / 2), SIZE / 2)
    state = at_rest(position, ((WATER, len(position)),), SIZE)
    state.position[:, 1] = 0.001 * SIZE - (0.0 if walls is Walls.SEPARATE else 0.5 * SIZE)
    state.velocity[:, 1] = 1.0
    run(tank(0.6, 0.6, SIZE, 30.0, gravity=(0.0, 0.0), walls=walls), state, 0.01)
    assert state.velocity[:, 1] == pytest.approx(speed, abs=1e-9)
