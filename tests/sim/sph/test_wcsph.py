"""Weakly compressible SPH: free fall, conservation, tanks at rest, broken dams."""

import dataclasses

import h5py
import numpy as np
import pytest

from nmpm.sim import InitialState, load_preset
from nmpm.sim.sph.boundary import PolygonObstacle, SolidBoundary
from nmpm.sim.sph.wcsph import Fluid, SphParticles, SphStepper

H = 0.02
WATER = Fluid(density=1000.0, speed_of_sound=20.0, exponent=7.0, alpha=0.1, viscosity=0.0, diffusion=0.0)
BOX = ((0.0, 1.0), (0.0, 1.0))
DT = 0.25 * H / 20.0


def lattice(columns, rows, low):
    nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(-1, 2)
    return np.array(low) + H * (nodes + 0.5)


def run(position, velocity, steps, gravity=(0.0, 0.0), fluid=WATER, box=BOX, dt=DT):
    state = SphParticles(position, velocity, fluid.density)
    stepper = SphStepper(fluid, SolidBoundary(box, (), H), H, np.array(gravity), dt)
    stepper.initialise(state)
    for _ in range(steps):
        stepper.step(state)
    return state, stepper


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def test_free_fall_is_exact():
    position = lattice(10, 10, (0.3, 0.7))
    start = np.array([0.3, 0.5])
    gravity = np.array([0.2, -9.81])
    state, _ = run(position, np.tile(start, (100, 1)), 400, gravity)
    t = 400 * DT
    np.testing.assert_allclose(state.position, position + start * t + gravity * t * t / 2, atol=1e-12)
    np.testing.assert_allclose(state.velocity, np.tile(start + gravity * t, (100, 1)), atol=1e-11)
    np.testing.assert_allclose(state.density, 1000.0, rtol=1e-12)


def test_momentum_and_angular_momentum_are_conserved_away_from_walls():
    rng = np.random.default_rng(0)
    position = lattice(15, 15, (0.35, 0.35)) + rng.uniform(-0.2 * H, 0.2 * H, (225, 2))
    velocity = rng.normal(scale=0.5, size=(225, 2))
    state, _ = run(position, velocity, 200)
    assert np.abs(state.velocity - velocity).max() > 0.5, "The test should push the particles."
    np.testing.assert_allclose(state.velocity.sum(0), velocity.sum(0), atol=1e-10)
    before, after = cross(position, velocity).sum(), cross(state.position, state.velocity).sum()
    assert after == pytest.approx(before, abs=1e-10)


def test_viscosity_brakes_a_shear_wave_at_its_rate_and_only_takes_energy():
    """u = sin k y is braked by ν k² u. Its axis is 22.5° from the lattice's, where the lattice favours no direction."""
    wave, fluid, position = 10.0, dataclasses.replace(WATER, viscosity=5.0), lattice(40, 40, (0.1, 0.1))
    along, across = np.array([[np.cos(np.pi / 8), np.sin(np.pi / 8)], [-np.sin(np.pi / 8), np.cos(np.pi / 8)]])
    velocity = 0.1 * np.sin(wave * (position - 0.5) @ across)[:, None] * along
    states = [run(position, velocity, steps, fluid=fluid)[0] for steps in (0, 50, 100)]
    inner = np.all(np.abs(states[0].table[:2] - 0.5) < 0.25, axis=0)
    speed, braking = (along @ states[0].table[rows][:, inner] for rows in (slice(2, 4), slice(5, 7)))
    rate = -(speed @ braking) / (speed @ speed)
    assert rate == pytest.approx(fluid.kinematic_viscosity(H) * wave**2, rel=0.02)
    energies = [(state.velocity**2).sum() for state in states]
    assert energies[0] > energies[1] > energies[2] > 0


def test_a_turned_scene_moves_as_the_straight_one():
    """A quarter turn of the box, its obstacle, the water and gravity, about the box's middle."""
    triangle, quarter = np.array([[-0.1, -0.3], [0.15, -0.25], [0.1, -0.1]]), np.array([[0.0, -1.0], [1.0, 0.0]])
    position, gravity, moved = lattice(15, 10, (-0.2, -0.05)), np.array([2.0, -9.0]), []
    fluid = dataclasses.replace(WATER, viscosity=1.0, diffusion=0.1)
    for turn in (np.eye(2), quarter):
        boundary = SolidBoundary(((-0.3, 0.3), (-0.3, 0.3)), (PolygonObstacle(triangle @ turn.T),), H)
        state = SphParticles(position @ turn.T, np.zeros_like(position), fluid.density)
        stepper = SphStepper(fluid, boundary, H, turn @ gravity, DT)
        stepper.initialise(state)
        for _ in range(800):
            stepper.step(state)
        moved.append(state.position @ turn - position)
    assert np.abs(moved[0] - gravity * (800 * DT) ** 2 / 2).max() > H, "Walls and obstacle should stop some water."
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-6 * H)


@pytest.mark.parametrize(("diffusion", "tolerance"), [pytest.param(0.0, 0.2, marks=pytest.mark.slow), (0.1, 0.05)])
def test_a_settled_tank_rests_with_hydrostatic_pressure(diffusion, tolerance):
    """30 × 15 particles, filled in without pressure; viscous, so that the sound of it dies away.

    Without diffusion, their pressure is noisy from particle to particle.
    """
    rows, fluid = 15, dataclasses.replace(WATER, alpha=1.0, diffusion=diffusion)
    position = lattice(30, rows, (0.0, 0.0))
    box = ((0.0, 30 * H), (0.0, 1.0))
    state, stepper = run(position, np.zeros_like(position), 6000, (0.0, -9.81), fluid, box)
    inner = (state.position > 3 * H).all(1) & (state.position[:, 0] < 27 * H)
    depth = rows * H - state.position[inner, 1]
    pressure = stepper.pressure(state)[inner]
    slope, surface = np.polyfit(depth, pressure, 1)
    bottom = 1000.0 * 9.81 * rows * H
    assert slope == pytest.approx(1000.0 * 9.81, rel=tolerance)
    assert abs(surface) < tolerance * bottom
    assert np.sqrt(np.mean((pressure - slope * depth - surface) ** 2)) < tolerance * bottom
    assert np.sqrt((state.velocity**2).sum(-1).mean()) < 0.02 * np.sqrt(9.81 * rows * H)
    assert np.abs(state.density / 1000 - 1).max() < 0.03
    assert stepper.held_back == 0
    assert (stepper.mass / state.density).sum() == pytest.approx(30 * rows * H * H, rel=0.01)
    assert state.position[:, 1].max() == pytest.approx(rows * H - H / 2, abs=0.5 * H)


def test_water_slips_along_walls_without_viscosity_and_is_braked_with():
    position = lattice(50, 5, (0.0, 0.0))
    velocity = np.tile([0.5, 0.0], (250, 1))
    wide = ((-1.0, 2.0), (0.0, 1.0))
    sticky = dataclasses.replace(WATER, viscosity=5.0)
    slipping, braked = (run(position, velocity, 400, (0.0, -1.0), fluid, wide)[0] for fluid in (WATER, sticky))
    assert slipping.velocity[:, 0].mean() == pytest.approx(0.5, rel=0.01)
    assert braked.velocity[:, 0].mean() < 0.45


def test_spray_bears_no_tension():
    pair = np.array([[0.5, 0.5], [0.5 + H, 0.5]])
    apart = np.array([[-0.2, 0.0], [0.2, 0.0]])
    state, _ = run(pair, apart, 200, fluid=dataclasses.replace(WATER, alpha=0.0))
    np.testing.assert_allclose(state.velocity, apart, atol=1e-3)
    assert np.all(state.density >= 1000.0)


# Martin & Moyce (1952), table 2, n² = 2: front over column width against t √(2 g / width).
MARTIN_MOYCE = np.array(
    [[1.19, 1.44], [1.43, 1.67], [1.63, 1.89], [1.83, 2.11], [1.98, 2.33], [2.20, 2.56], [2.32, 2.78], [2.51, 3.00]]
)


@pytest.mark.slow
def test_the_dam_breaks_front_is_that_of_martin_and_moyce():
    """A gate takes time to lift, so speeds agree better than places: within 12% and a quarter of a width."""
    h = 1 / 16
    fluid = Fluid(1.0, 25.0, 7.0, 0.05, 0.0, 0.1)
    dt = 0.25 * h / 25.0
    nodes = np.stack(np.meshgrid(np.arange(16), np.arange(32), indexing="ij"), -1).reshape(-1, 2)
    state = SphParticles(h * (nodes + 0.5), np.zeros((512, 2)), 1.0)
    stepper = SphStepper(fluid, SolidBoundary(((0.0, 5.0), (0.0, 3.0)), (), h), h, np.array([0.0, -1.0]), dt)
    stepper.initialise(state)
    fronts, t = [], 0.0
    for late, _ in MARTIN_MOYCE:
        while t * np.sqrt(2) < late:
            stepper.step(state)
            t += dt
        fronts.append(state.position[:, 0].max() + h / 2)
    speed = np.polyfit(MARTIN_MOYCE[:, 0], fronts, 1)[0]
    measured = np.polyfit(MARTIN_MOYCE[:, 0], MARTIN_MOYCE[:, 1], 1)[0]
    assert speed == pytest.approx(measured, rel=0.12)
    assert np.abs(np.array(fronts) - MARTIN_MOYCE[:, 1]).max() < 0.25
    ritter = 2 * np.sqrt(2.0)
    assert speed * np.sqrt(2) < ritter, "Nothing outruns Ritter's front, 2 √(g H)."


def test_the_list_of_pairs_is_renewed_in_time():
    position = lattice(30, 10, (0.0, 0.0))
    fluid = dataclasses.replace(WATER, diffusion=0.1)
    states = []
    for always in (False, True):
        state = SphParticles(position, np.zeros_like(position), fluid.density)
        stepper = SphStepper(fluid, SolidBoundary(((0.0, 30 * H), (0.0, 1.0)), (), H), H, np.array([4.0, -9.0]), DT)
        stepper.initialise(state)
        for _ in range(400):
            if always:
                stepper._list_pairs(state)
            stepper.step(state)
        states.append(state)
    assert np.abs(states[0].position - position).max() > H, "The test should move particles past the room to spare."
    np.testing.assert_allclose(states[0].position, states[1].position, atol=1e-3 * H)


def test_non_finite_states_are_detected():
    state, stepper = run(lattice(10, 10, (0.4, 0.4)), np.zeros((100, 2)), 1)
    state.table[4, 17] = np.nan
    stepper.step(state)
    with pytest.raises(FloatingPointError):
        stepper.step(state)


@pytest.mark.slow
def test_every_particle_moves_as_jax_sphs_until_the_wave_is_far_out(recorded):
    """From its own first frame, long before the impact, after which the flow is chaotic."""
    preset, frames = load_preset("dambreak2d"), 60
    with h5py.File(recorded / "jaxsph-dambreak-2d" / "test.h5") as file:
        kinds = file["00000/particle_type"][:]
        position = file["00000/position"][: frames + 1].astype(np.float64)
    theirs, walls = position[:, kinds == 0], position[0, kinds == 1]
    boundary = SolidBoundary(preset.box, (), preset.spacing)
    mine = boundary.position[boundary.visible]
    np.testing.assert_allclose(mine[np.lexsort(mine.round(3).T)], walls[np.lexsort(walls.round(3).T)], atol=1e-5)
    made = preset.simulate_from(InitialState(theirs[0], np.zeros_like(theirs[0])), frames).position
    water = made[:, : theirs.shape[1]].astype(np.float64)
    assert np.sqrt(((water - theirs) ** 2).sum(-1).mean(-1))[-1] < 0.1 * preset.spacing
    np.testing.assert_allclose(water[..., 0].max(1) / theirs[..., 0].max(1), 1.0, atol=0.005)
    energies = [0.5 * (np.gradient(each, 0.03, axis=0) ** 2).sum(axis=(1, 2))[5:] for each in (water, theirs)]
    np.testing.assert_allclose(*energies, rtol=0.02)
