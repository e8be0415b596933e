import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.errors import DataError
from nmpm.sim.mpm.layouts import SimulatedRamp
from nmpm.sim.mpm.materials import Goop, Sand, Water
from nmpm.sim.mpm.obstacle_field import ObstacleField
from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles, MpmStepper

SIZE, CELLS, DT = 0.0125, 48, 2e-4
WATER = Water(density=1000.0, bulk_modulus=7e4)
SAND = Sand(density=1000.0, young=1e5, poisson=0.3, friction_angle=30.0)
GOOP = Goop(density=1000.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)


def strip(centre, angle, length, thickness):
    """Exact signed distance from a slanted rectangle."""
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])

    def distance(points):
        arm = points - np.asarray(centre)
        beyond = np.abs(np.stack([arm @ along, arm @ across], -1)) - np.array([length, thickness]) / 2
        return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)

    return distance


def stepper(distance, friction=0.3, gravity=(0.0, -9.81)):
    field = ObstacleField.sample(distance, np.zeros(2), SIZE, (CELLS, CELLS), friction)
    return MpmStepper(MpmGrid(np.zeros(2), SIZE, (CELLS, CELLS), friction, np.array(gravity), obstacles=field), DT)


def block(columns, rows, low):
    return np.array(low) + SIZE / 2 * (np.stack(np.meshgrid(range(columns), range(rows)), -1).reshape(-1, 2) + 0.5)


def state(position, velocity, material=WATER):
    return MpmParticles(position, velocity, ((material, len(position)),), (SIZE / 2) ** 2)


angles = st.floats(-math.pi / 2, math.pi / 2)


centres = st.tuples(st.floats(0.1, 0.5), st.floats(0.0, 0.35))


materials = st.sampled_from([WATER, SAND, GOOP])


@settings(max_examples=10, deadline=None)
@given(centres, angles, st.floats(0.1, 0.5), st.floats(0.25, 6), st.floats(0, 6), st.floats(0, 1), materials)
def test_no_particle_is_ever_inside_an_obstacle_or_outside_of_the_box(
    centre, angle, length, cells, speed, friction, material
):
    distance = strip(centre, angle, length, cells * SIZE)
    run = stepper(distance, friction)
    position = block(40, 8, (0.15, 0.5))
    position = position[distance(position) > SIZE]
    moving = state(position, np.tile([0.3 * speed, -speed], (len(position), 1)), material)
    run.enclose(moving)
    for _ in range(200):
        run.step(moving)
        assert distance(moving.position).min() >= 0
        assert moving.position.min() > 0
        assert moving.position.max() < CELLS * SIZE
    assert run.held_back == 0


def test_a_particle_too_near_is_pushed_out_without_its_velocity_inwards():
    field = stepper(strip((0.3, 0.3), 0.0, 0.4, 0.1)).grid.obstacles
    before = np.array([[0.3, 0.36], [0.3, 0.3535], [0.3, 0.4]])
    position, velocity = before - [[0.0, 0.012], [0.0, 0.0], [0.0, 0.0]], np.tile([1.0, -2.0], (3, 1))
    assert field.push_out(before, position, velocity, np.zeros(2), np.ones(2)) == 1
    np.testing.assert_allclose(position, [[0.3, 0.35 + field.lattice.margin], *before[1:].tolist()], atol=1e-3 * SIZE)
    np.testing.assert_allclose(velocity, [[1.0, 0.0], [1.0, -2.0], [1.0, -2.0]], atol=1e-12)


def ramp(centre, angle, turn):
    return SimulatedRamp(centre, 0.4, 0.05, angle, width=0.4, turn=turn)


def stepper_3d(distance, friction, cells=32):
    field = ObstacleField.sample(distance, np.zeros(3), SIZE, (cells,) * 3, friction)
    grid = MpmGrid(np.zeros(3), SIZE, (cells,) * 3, friction, np.array([0.0, -9.81, 0.0]), obstacles=field)
    return MpmStepper(grid, DT)


def cube(sides, low):
    points = np.stack(np.meshgrid(*map(range, sides), indexing="ij"), -1).reshape(-1, 3)
    return np.array(low) + SIZE / 2 * (points + 0.5)


@pytest.mark.parametrize(("angle", "turn"), [(0.4, 0.0), (-0.7, 2.0), (0.0, 1.0)])
def test_water_in_three_dimensions_never_enters_a_slab(angle, turn):
    slab = ramp((0.2, 0.12, 0.2), angle, turn)
    run = stepper_3d(slab.distance, 0.0)
    position = cube((12, 8, 12), (0.17, 0.28, 0.17))
    moving = MpmParticles(position, np.tile([0.0, -4.0, 0.0], (len(position), 1)), ((WATER, len(position)),), 2e-7)
    run.enclose(moving)
    for _ in range(250):
        run.step(moving)
        assert slab.distance(moving.position).min() >= 0
    assert slab.distance(moving.position).min() < 2 * SIZE
    assert run.held_back == 0


def test_a_particle_too_near_a_slab_is_pushed_out_without_its_velocity_inwards():
    slab = ramp((0.2, 0.15, 0.2), 0.4, 0.8)
    field, (_, out, wide) = stepper_3d(slab.distance, 0.0).grid.obstacles, slab._axes
    before = np.array(slab.centre) + np.outer([0.06, 0.0353, 0.1], out)
    position, velocity = before - np.outer([0.03, 0.0, 0.0], out), np.tile(wide - 2.0 * out, (3, 1))
    assert field.push_out(before, position, velocity, np.zeros(3), np.ones(3)) == 1
    np.testing.assert_allclose(slab.distance(position), [field.lattice.margin, 0.0103, 0.075], atol=0.01 * SIZE)
    np.testing.assert_allclose(velocity, [wide, wide - 2.0 * out, wide - 2.0 * out], atol=1e-9)


@pytest.mark.parametrize("friction", [0.0, 0.2, 5.0])
def test_nodes_at_a_slab_keep_the_velocity_along_it_less_friction(friction):
    slab = ramp((0.2, 0.15, 0.2), 0.4, 0.8)
    field, (along, out, wide) = stepper_3d(slab.distance, friction).grid.obstacles, slab._axes
    above = np.argwhere(np.abs(field.normals - out).max(1) < 1e-6)[:, 0]
    assert len(above) > 50
    nodes = np.zeros((34, 34, 34, 4))
    nodes[..., 0], fall = 2.0, np.array([0.1, -0.5, 0.0])
    nodes[..., 1:] = 2.0 * (3.0 * along + 4.0 * wide - 2.0 * out - fall)
    field.brake(nodes, fall)
    after = nodes[tuple(field.nodes[above].T)][:, 1:] / 2.0 + fall
    expected = (3.0 * along + 4.0 * wide) * max(0.0, 1 - friction * 2.0 / 5.0)
    np.testing.assert_allclose(after, np.tile(expected, (len(above), 1)), atol=1e-9)


@pytest.mark.parametrize(("friction", "tolerance"), [(0.0, 0.03), (0.2, 0.06), (0.9, 0.03)])
def test_a_layer_slides_down_a_ramp_as_coulomb_says(friction, tolerance):
    angle, time = math.radians(25), 0.2
    along, out = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    distance = strip(np.array([0.3, 0.2]) - 0.05 * out, angle, 2.0, 0.1)
    run = stepper(distance, friction)
    slab = block(24, 2, (0, 0)) - [12 * SIZE / 2, 0]
    position = np.array([0.35, 0.22]) + slab[:, :1] * along + (slab[:, 1:] + 0.75 * SIZE) * out
    stiff = Goop(density=1000.0, young=4e5, poisson=0.3, yield_stress=1e9, viscosity=1e9)
    moving = state(position, np.zeros_like(position), stiff)
    for _ in range(round(time / DT)):
        run.step(moving)
    pull = max(0.0, math.sin(angle) - friction * math.cos(angle))
    assert -(moving.velocity @ along).mean() == pytest.approx(9.81 * time * pull, abs=tolerance * 9.81 * time)


def test_material_leaves_an_obstacle_freely():
    run = stepper(strip((0.3, 0.1), 0.0, 2.0, 0.1), gravity=(0.0, 0.0))
    position = block(12, 12, (0.2, 0.155))
    moving = state(position, np.tile([0.0, 2.0], (len(position), 1)))
    for _ in range(200):
        run.step(moving)
    np.testing.assert_allclose(moving.velocity, np.tile([0.0, 2.0], (len(position), 1)), atol=1e-9)


def test_enclose_pushes_particles_out_of_obstacles_or_names_them():
    distance = strip((0.3, 0.3), 0.4, 0.2, 0.1)
    position = block(20, 20, (0.25, 0.25))
    assert distance(position).min() < 0
    particles = state(position, np.zeros_like(position))
    stepper(distance).enclose(particles)
    assert distance(particles.position).min() >= 0
    with pytest.raises(DataError, match=r"Particle 0 at .* inside an obstacle"):
        stepper(lambda points: np.full(len(points), -1.0)).enclose(state(block(1, 1, (0.3, 0.3)), np.zeros((1, 2))))


def test_an_obstacle_thinner_than_cells_lets_no_jet_through():
    run = stepper(strip((0.3, 0.3), 0.3, 2.0, 0.25 * SIZE))
    position = block(16, 16, (0.25, 0.45))
    moving = state(position, np.tile([0.0, -5.0], (len(position), 1)))
    for _ in range(500):
        run.step(moving)
    assert ((moving.position - 0.3) @ np.array([-math.sin(0.3), math.cos(0.3)])).min() > 0
