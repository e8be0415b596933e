import dataclasses

import numpy as np
import pytest

from nmpm.errors import ConfigError
from nmpm.sim import InitialState, load_preset, preset_from_dict
from nmpm.sim.mpm.mls_mpm_2d import Stepper2d
from nmpm.sim.mpm.mls_mpm_3d import Stepper3d
from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles, Walls
from nmpm.sim.mpm.water import Water

WATER = Water(density=1000.0, bulk_modulus=7.0e4)
SIZE = 0.05


def grid(cells: int = 20, gravity: tuple[float, ...] = (0.0, 0.0, 0.0), **changes: object) -> MpmGrid:
    plain = MpmGrid(np.zeros(3), SIZE, (cells,) * 3, 0.0, np.array(gravity))
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def cloud(low: tuple[float, ...], shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """A lattice of eight particles per cell, a little disturbed."""
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    shift = np.random.default_rng(seed).uniform(-0.1, 0.1, nodes.shape)
    return np.array(low) + SIZE / 2 * (nodes + 0.5 + shift)


def state(position: np.ndarray, velocity: np.ndarray) -> MpmParticles:
    return MpmParticles(position, velocity, ((WATER, len(position)),), (SIZE / 2) ** 3)


def test_free_fall_is_exact():
    start = cloud((0.4, 0.6, 0.4), (5, 5, 5))
    water = state(start, np.full_like(start, 0.3))
    stepper, gravity = Stepper3d(grid(gravity=(1.0, -9.81, 0.5)), 1e-4), np.array([1.0, -9.81, 0.5])
    for _ in range(200):
        stepper.step(water)
    time = 200 * 1e-4
    # Gravity acts before the move: one half substep more than in the continuum.
    moved = 0.3 * time + 0.5 * gravity * time * (time + 1e-4)
    np.testing.assert_allclose(water.position - start, np.broadcast_to(moved, start.shape), atol=1e-10)


def test_momentum_and_angular_momentum_are_kept_in_free_flight():
    start = cloud((0.35, 0.35, 0.35), (8, 6, 7))
    spin = np.cross(np.array([3.0, -2.0, 4.0]), start - start.mean(axis=0))
    water = state(start, spin + np.array([0.2, 0.1, -0.3]))

    def momenta() -> tuple[np.ndarray, np.ndarray]:
        mass = water.mass[:, None]
        orbital = np.cross(water.position, mass * water.velocity).sum(axis=0)
        # The affine field carries the rest: h²/4 per particle times the antisymmetric part of its gradient.
        turn = water.gradient - water.gradient.transpose(0, 2, 1)
        own = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
        return (mass * water.velocity).sum(axis=0), orbital + SIZE**2 / 4 * (mass * own).sum(axis=0)

    stepper = Stepper3d(grid(), 1e-4)
    stepper.step(water)
    linear, angular = momenta()
    for _ in range(100):
        stepper.step(water)
    np.testing.assert_allclose(momenta()[0], linear, rtol=1e-10)
    np.testing.assert_allclose(momenta()[1], angular, rtol=1e-8)


def test_axes_are_equal():
    start = cloud((0.0, 0.0, 0.0), (8, 10, 6))
    runs = []
    for turn in (0, 1, 2):
        position = np.roll(start, turn, axis=1)
        gravity = np.roll([0.3, -9.81, 0.1], turn)
        stepper = Stepper3d(grid(12, tuple(gravity), walls=Walls.SEPARATE), 2e-4)
        water = state(position, np.zeros_like(position))
        stepper.enclose(water)
        for _ in range(150):
            stepper.step(water)
        runs.append(np.roll(water.position, -turn, axis=1))
    # Walls act one after the other, so that only rounding may tell the axes apart where there is no friction.
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-9)
    np.testing.assert_allclose(runs[2], runs[0], atol=1e-9)


def test_a_slab_that_fills_the_depth_moves_as_in_two_dimensions():
    shape, depth = (10, 14), 16
    flat = SIZE / 2 * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2) + 0.5)
    layers = SIZE / 2 * (np.arange(depth) + 0.5)
    deep = np.concatenate([np.repeat(flat, depth, axis=0), np.tile(layers, len(flat))[:, None]], axis=1)
    plane_grid = MpmGrid(np.zeros(2), SIZE, (16, 12), 0.0, np.array([0.0, -9.81]))
    box_grid = MpmGrid(np.zeros(3), SIZE, (16, 12, 8), 0.0, np.array([0.0, -9.81, 0.0]))
    plane = MpmParticles(flat, np.zeros_like(flat), ((WATER, len(flat)),), (SIZE / 2) ** 2)
    box = state(deep, np.zeros_like(deep))
    two, three = Stepper2d(plane_grid, 2e-4), Stepper3d(box_grid, 2e-4)
    for _ in range(600):
        two.step(plane)
        three.step(box)
    moved = plane.position - flat
    columns = box.position.reshape(len(flat), depth, 3)
    assert np.abs(moved).max() > 0.05
    # The end walls disturb the nearest cells of the slab a little: its kernel has no nodes beyond them to lean on.
    assert np.abs(columns[:, 4:12, :2].mean(axis=1) - flat - moved).max() < 0.02 * np.abs(moved).max()


def test_pressure_at_the_bottom_carries_the_column():
    cells, height = 6, 16
    start = cloud((0.0, 0.0, 0.0), (2 * cells, 2 * height, 2 * cells))
    water = state(start, np.zeros_like(start))
    box = MpmGrid(np.zeros(3), SIZE, (cells, 2 * height, cells), 0.0, np.array([0.0, -9.81, 0.0]))
    stepper = Stepper3d(box, 5e-4)
    stepper.enclose(water)
    sums, count = np.zeros(len(start)), 0
    for step in range(2400):
        stepper.step(water)
        water.velocity *= 0.998  # comes to rest
        if step > 2000:
            sums, count = sums - water.stress[:, 0], count + 1
    middle = (start[:, 1] > 3 * SIZE) & (start[:, 1] < (height - 3) * SIZE)
    slope = np.polyfit(water.position[middle, 1], (sums / count)[middle], 1)[0]
    assert slope == pytest.approx(-9.81 * 1000, rel=0.1)


def test_friction_slows_sliding_material():
    start = cloud((0.2, 0.0, 0.3), (6, 4, 6))
    throw = np.broadcast_to([1.0, 0.0, 0.5], start.shape)
    speeds = []
    for friction in (0.0, 0.5):
        stepper = Stepper3d(grid(gravity=(0.0, -9.81, 0.0), friction=friction), 2e-4)
        water = state(start, throw)
        for _ in range(300):
            stepper.step(water)
        speeds.append(water.velocity[:, [0, 2]].mean(axis=0))
    assert np.all(speeds[1] < speeds[0] - 0.1)
    # It pulls straight back: the direction stays.
    assert speeds[1][1] / speeds[1][0] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("walls", [Walls.SEPARATE, Walls.SLIP])
def test_fast_particles_stay_in_the_box(walls):
    rng = np.random.default_rng(0)
    start = rng.uniform(0.15, 0.85, (400, 3))
    water = state(start, rng.normal(scale=20.0, size=start.shape))
    stepper = Stepper3d(grid(walls=walls), 2e-4)
    for _ in range(300):
        stepper.step(water)
        assert np.all((water.position >= 0) & (water.position <= 1))


def test_non_finite_velocities_are_detected():
    start = cloud((0.4, 0.4, 0.4), (3, 3, 3))
    water = state(start, np.zeros_like(start))
    water.velocity[4, 2] = np.nan
    with pytest.raises(FloatingPointError):
        Stepper3d(grid(), 1e-4).step(water)


def test_features_of_two_dimensions_only_are_refused():
    with pytest.raises(ConfigError, match="in two dimensions, not in three"):
        Stepper3d(grid(walls=Walls.OPEN_CORNERS), 1e-4)
    plain = load_preset("waterdrop3d").to_dict()
    with pytest.raises(ConfigError, match="open corners are implemented in two dimensions"):
        preset_from_dict(plain | {"walls": "slip, open corners"})
    with pytest.raises(ConfigError, match="sand is implemented in two dimensions, not in 3"):
        preset_from_dict(plain | {"materials": load_preset("sandramps").to_dict()["materials"]})


def test_the_preset_stays_in_its_box_and_keeps_its_water():
    preset = load_preset("waterdrop3d")
    start = cloud((0.2, 0.15, 0.2), (8, 8, 8)) * 0.35 / SIZE * 0.05 + 0.2
    made = preset.simulate_from(InitialState(start, np.full_like(start, 0.8)), 60)
    low, high = np.array(preset.scene.bounds).T
    assert made.position.shape == (61, 512, 3)
    assert np.all((made.position >= low - 1e-6) & (made.position <= high + 1e-6))
    assert made.attributes["held_back"] == 0
