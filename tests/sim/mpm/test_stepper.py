"""Substeps in two and three dimensions: free fall, conservation, walls, friction."""

from itertools import permutations

import numpy as np
import pytest
from columns import at_rest, lattice, run, tank
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.sim.mpm.materials import Goop, Sand, Water
from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles, MpmStepper, Walls

SIZE = 0.025
WATER = Water(density=1000.0, bulk_modulus=7e4)
SAND = Sand(density=1600.0, young=3.5e5, poisson=0.3, friction_angle=30.0)
GOOP = Goop(density=1200.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)
MATERIALS = [WATER, SAND, GOOP]
GRAVITY = np.array([1.0, -9.81, 0.5])


def grid(dim, gravity=None, cells=20, friction=0.0, walls=Walls.SEPARATE):
    pull = np.zeros(dim) if gravity is None else np.array(gravity)
    return MpmGrid(np.zeros(dim), SIZE, (cells,) * dim, friction, pull, walls)


def cloud(low, shape, seed=0):
    """A lattice of particles half a cell apart, a little disturbed."""
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, len(shape))
    return np.array(low) + SIZE / 2 * (nodes + 0.5 + np.random.default_rng(seed).uniform(-0.1, 0.1, nodes.shape))


def state(position, velocity, material=WATER):
    dim = position.shape[1]
    return MpmParticles(
        position, np.broadcast_to(velocity, position.shape), ((material, len(position)),), (SIZE / 2) ** dim
    )


def momentum(particles):
    return (particles.mass[:, None] * particles.velocity).sum(axis=0)


def mixed(blocks):
    """A block of each material, given by their lower corners."""
    parts = [lattice(low, np.add(low, 0.15), SIZE / 2) for low in blocks]
    return at_rest(np.concatenate(parts), tuple(zip(MATERIALS, map(len, parts), strict=True)), SIZE)


@pytest.mark.parametrize(("dim", "material"), [(2, WATER), (2, SAND), (2, GOOP), (3, WATER)])
def test_free_fall_is_exact(dim, material):
    position = cloud((0.2,) * dim, (5,) * dim)
    particles = state(position, 0.3, material)
    stepper = MpmStepper(grid(dim, GRAVITY[:dim]), 1e-4)
    for _ in range(200):
        stepper.step(particles)
    time = 200 * 1e-4
    # Gravity acts at the start of each substep, so that the fall runs ahead by half a substep's worth.
    fallen = 0.3 * time + 0.5 * GRAVITY[:dim] * time * (time + 1e-4)
    np.testing.assert_allclose(particles.position - position, np.broadcast_to(fallen, position.shape), atol=1e-10)


@pytest.mark.parametrize(("dim", "material"), [(2, GOOP), (3, WATER)])
def test_momentum_and_angular_momentum_are_conserved_away_from_walls(dim, material):
    position = cloud((0.18,) * dim, (8, 6, 7)[:dim])
    spin = np.cross(np.array([3.0, -2.0, 40.0]), np.pad(position - position.mean(axis=0), ((0, 0), (0, 3 - dim))))
    particles = state(
        position, spin[:, :dim] + np.random.default_rng(0).normal(scale=0.3, size=position.shape), material
    )

    def momenta():
        """With the affine motion that each particle carries: h²/4 times its gradient's antisymmetric part."""
        turn = np.zeros((len(position), 3, 3))
        turn[:, :dim, :dim] = particles.gradient - particles.gradient.transpose(0, 2, 1)
        place, velocity = (np.pad(each, ((0, 0), (0, 3 - dim))) for each in (particles.position, particles.velocity))
        carried = SIZE**2 / 4 * np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
        return momentum(particles), (particles.mass[:, None] * (np.cross(place, velocity) + carried)).sum(axis=0)

    stepper = MpmStepper(grid(dim), 1e-4)
    stepper.step(particles)
    linear, angular = momenta()
    for _ in range(60):
        stepper.step(particles)
    assert np.abs(particles.stress).max() > 100, "The test should strain the material."
    np.testing.assert_allclose(momenta()[0], linear, rtol=1e-9, atol=1e-10 * particles.mass.sum())
    np.testing.assert_allclose(momenta()[1], angular, rtol=1e-8, atol=1e-10 * particles.mass.sum())


@pytest.mark.parametrize("dim", [2, 3])
def test_the_grid_receives_the_mass_and_momentum_of_the_particles(dim):
    """Whatever their velocity gradients and stresses, and with gravity's impulse."""
    rng, dt = np.random.default_rng(0), 1e-3
    position = cloud((0.15,) * dim, (6, 8, 5)[:dim])
    particles = state(position, rng.normal(size=position.shape))
    particles.strain[:] = rng.uniform(0.9, 1.0, particles.strain.shape)
    particles.gradient[:] = rng.normal(scale=20.0, size=particles.gradient.shape)
    expected = momentum(particles) + particles.mass.sum() * dt * GRAVITY[:dim]
    stepper = MpmStepper(grid(dim, GRAVITY[:dim]), dt)
    stepper.step(particles)
    mass, velocity = stepper._nodes[..., 0], stepper._nodes[..., 1:]
    assert np.abs(particles.stress).max() > 100, "The test should strain the material."
    assert mass.sum() == pytest.approx(len(position) * 1000.0 * (SIZE / 2) ** dim, rel=1e-12)
    received = (mass[..., None] * velocity).reshape(-1, dim).sum(axis=0)
    np.testing.assert_allclose(received, expected, rtol=1e-9, atol=1e-12 * particles.mass.sum())


@settings(max_examples=10, deadline=None)
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


@pytest.mark.parametrize(("friction", "expected"), [(0.0, 1.0), (0.3, 1.0 - 0.3 * 9.81 * 0.1), (5.0, 0.0)])
def test_a_thin_layer_slides_to_a_stop_by_coulomb_friction(friction, expected):
    position = lattice((3 * SIZE, 0.5 * SIZE), (0.5 + 3 * SIZE, 1.5 * SIZE), SIZE / 2)
    particles = state(position, [1.0, 0.0], GOOP)
    stepper = MpmStepper(grid(2, (0.0, -9.81), 32, friction), 2e-4)
    for _ in range(500):
        stepper.step(particles)
    assert momentum(particles)[0] / particles.mass.sum() == pytest.approx(expected, abs=0.1)


def test_a_slab_that_fills_the_depth_moves_as_in_two_dimensions():
    flat = lattice((0, 0), (0.125, 0.175), SIZE / 2)
    layers = SIZE / 2 * (np.arange(16) + 0.5)
    deep = np.concatenate([np.repeat(flat, 16, axis=0), np.tile(layers, len(flat))[:, None]], axis=1)
    two = MpmStepper(MpmGrid(np.zeros(2), SIZE, (16, 12), 0.0, np.array([0.0, -9.81])), 2e-4)
    three = MpmStepper(MpmGrid(np.zeros(3), SIZE, (16, 12, 8), 0.0, np.array([0.0, -9.81, 0.0])), 2e-4)
    plane, box = state(flat, 0.0), state(deep, 0.0)
    for _ in range(400):
        two.step(plane)
        three.step(box)
    moved = plane.position - flat
    assert np.abs(moved).max() > 0.03
    # The end walls disturb the nearest cells of the slab a little: its kernel has no nodes beyond them to lean on.
    inner = box.position.reshape(len(flat), 16, 3)[:, 4:12, :2].mean(axis=1)
    assert np.abs(inner - flat - moved).max() < 0.02 * np.abs(moved).max()


@pytest.mark.parametrize("walls", [Walls.SEPARATE, Walls.SLIP])
def test_the_axes_of_three_dimensions_are_equal(walls):
    """Without friction, where walls meet only rounding may tell the axes apart."""
    start = cloud((2 * SIZE,) * 3, (6, 9, 5))
    moved = []
    for axes in map(list, permutations(range(3))):
        box = MpmGrid(np.zeros(3), SIZE, tuple(np.array([8, 9, 8])[axes]), 0.0, GRAVITY[axes], walls)
        stepper, particles = MpmStepper(box, 2e-4), state(start[:, axes], np.array([2.0, 2.0, -2.0])[axes])
        stepper.enclose(particles)
        for _ in range(150):
            stepper.step(particles)
        moved.append(particles.position[:, np.argsort(axes)] - start)
    assert np.abs(moved[0]).max() > SIZE / 2
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], np.shape(moved)), atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_non_finite_states_are_detected(dim):
    particles = state(cloud((0.2,) * dim, (4,) * dim), 0.0)
    particles.velocity[4, 1] = np.nan
    with pytest.raises(FloatingPointError):
        MpmStepper(grid(dim), 1e-4).step(particles)


def test_friction_in_three_dimensions_brakes_along_the_velocity():
    speeds = []
    for friction in (0.0, 0.5):
        stepper = MpmStepper(grid(3, (0.0, -9.81, 0.0), friction=friction), 2e-4)
        particles = state(cloud((0.1, 0.0, 0.15), (6, 4, 6)), [1.0, 0.0, 0.5])
        for _ in range(300):
            stepper.step(particles)
        speeds.append(particles.velocity[:, [0, 2]].mean(axis=0))
    assert np.all(speeds[1] < speeds[0] - 0.1)
    assert speeds[1][1] / speeds[1][0] == pytest.approx(0.5, rel=0.1)
