"""Every shipped preset at its fewest stable substeps, coarse and fine: energy never grows, and it stays near the truth.

`benchmarks/stable_substeps.py` measures the same over whole trajectories of all presets.
"""

import dataclasses
import functools

import numpy as np
import pytest

from nmpm.sim import load_preset, preset_names
from nmpm.sim.mpm.materials import Goop, Water
from nmpm.sim.mpm.preset import fastest_speed, longest_particle_substep, longest_travel_substep
from nmpm.sim.preset import BOUNDARY

FRAMES, COMPARED_FROM = 80, 60
SPH = [name for name in preset_names() if load_preset(name).solver == "wcsph"]
MPM = [name for name in preset_names() if load_preset(name).solver == "mls_mpm"]
FACTORS = (pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow), 4)


def energies(preset, start, position):
    """Kinetic and potential energy per mass over time, and initially; the potential is 0 at the box's lowest point."""
    low, high = np.array(preset.box).T
    gravity = np.array(start.gravity)
    bottom = np.where(gravity > 0, high, low)
    velocity = np.diff(position.astype(np.float64), axis=0) / preset.frame_dt
    middle = (position[1:].mean(1) + position[:-1].mean(1)) / 2
    initial = (start.velocity**2).sum(-1).mean() / 2 - (start.position.mean(0) - bottom) @ gravity
    return (velocity**2).sum(-1).mean(-1) / 2 - (middle - bottom) @ gravity, initial


def simulate(preset, seed, frames):
    """Positions of the particles that move, checked to be finite and without new energy."""
    start = preset.draw(seed)
    made = preset.simulate_from(start, frames)
    position = made.position[:, made.particle_type != BOUNDARY]
    energy, initial = energies(preset, start, position)
    assert np.isfinite(position).all()
    assert energy.max() <= 1.01 * initial
    assert made.attributes["held_back"] == 0 or preset.solver == "wcsph"
    return position


@functools.cache
def shipped(name):
    return simulate(load_preset(name), 0, FRAMES)[COMPARED_FROM:]


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", MPM)
def test_a_coarse_grid_is_stable_and_nearer_than_nothing_moving(name, factor):
    preset = load_preset(name)
    made, truth = simulate(preset.coarsened(factor), 0, FRAMES), shipped(name)
    still = np.mean((made[0] - truth) ** 2)
    assert np.mean((made[COMPARED_FROM:] - truth) ** 2) < 0.2 * still


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", SPH)
def test_coarse_particles_are_stable_and_move_as_a_whole_as_fine_ones(name, factor):
    preset = load_preset(name)
    made = simulate(preset.coarsened(factor), 0, 20)
    fine = preset.layout.max_particles(preset.spacing)
    assert made.shape[1] == pytest.approx(fine / factor**2, rel=0.15)


# Scenes that fewer substeps made unstable, most of them late: seeds found by trying a dozen of each.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "factor", "seed"),
    [
        ("waterramps", 1, 3), ("waterramps", 1, 11), ("waterramps", 4, 11), ("variablegravity", 1, 8),
        ("variablegravity", 2, 3), ("variablegravity", 4, 3), ("waterdrop", 1, 0), ("multimaterial", 2, 4),
        ("waterdrop-xl", 2, 3), ("waterdrop-xl", 4, 0),
    ],
)  # fmt: skip
def test_whole_trajectories_are_stable(name, factor, seed):
    preset = load_preset(name).coarsened(factor)
    simulate(preset, seed, preset.frames)


WATER = Water(density=1000.0, bulk_modulus=7e4)
GOOP = Goop(density=1000.0, young=4e5, poisson=0.4, yield_stress=200.0, viscosity=60.0)


def lone_particle(material, cell_size, dim, dt, rate, steps=400):
    """Largest |∇·v| of a lone particle after it is compressed at a rate: what its own stress does at the nodes."""
    strain, stress = np.array([material.rest(dim)]), np.zeros((1, dim * (dim + 1) // 2))
    gradient, largest = -rate / dim * np.eye(dim)[None], 0.0
    diagonal = np.cumsum([0, *range(dim, 1, -1)])
    for _ in range(steps):
        material.respond(strain, gradient, stress, dt)
        gradient[0, range(dim), range(dim)] -= 4 * dt / (material.density * cell_size**2) * stress[0, diagonal]
        largest = max(largest, abs(np.trace(gradient[0])))
        if not np.isfinite(largest):
            return np.inf
    return largest


@pytest.mark.parametrize(("material", "dim"), [(WATER, 2), (WATER, 3), (GOOP, 2)])
def test_a_lone_particle_at_rest_is_stable_up_to_the_bound_and_not_beyond(material, dim):
    """Slightly compressed, it swings; from ω dt = 2 on the swings grow."""
    longest = longest_particle_substep(material, 0.01, dim, speed=0.0)
    assert lone_particle(material, 0.01, dim, 0.98 * longest, rate=1e-3) < 0.1
    assert lone_particle(material, 0.01, dim, 1.02 * longest, rate=1e-3) > 10
    assert longest_particle_substep(WATER, 0.01, dim, 0.0) == pytest.approx(0.01 / WATER.wave_speed / np.sqrt(dim))


@pytest.mark.parametrize("exponent", [-1.0, 1.0, 7.0])
@pytest.mark.parametrize("speed", [0.5, 2.0, 4.0])
def test_stiffness_is_that_where_the_pressures_work_equals_the_kinetic_energy(exponent, speed):
    water = dataclasses.replace(WATER, exponent=exponent)
    volumes = np.linspace(1.0, 0.3, 70_001)
    pressure = np.array([water.pressure(volume) for volume in volumes])
    work = np.concatenate([[0.0], np.cumsum((pressure[1:] + pressure[:-1]) / 2 * -np.diff(volumes))])
    deepest = int(np.searchsorted(work, 1000.0 * speed**2 / 2))
    stiffness = (-np.gradient(volumes * pressure, np.log(volumes)))[1 : deepest + 1].max()
    assert water.bulk_stiffness(1000.0 * speed**2 / 2) == pytest.approx(max(stiffness, 7e4), rel=2e-3)


def test_speeds_and_ways_that_bound_a_substep():
    assert fastest_speed(0.0, (0.0, -9.81), (2.0, 0.8), turns=False) == pytest.approx(np.sqrt(2 * 9.81 * 0.8))
    assert fastest_speed(3.0, (0.0, 0.0), (2.0, 0.8), turns=False) == pytest.approx(3.0 * np.sqrt(2))
    diagonal = np.hypot(2.0, 0.8)
    assert fastest_speed(0.0, (0.0, -9.81), (2.0, 0.8), turns=True) == pytest.approx(np.sqrt(2 * 9.81 * diagonal))
    assert longest_travel_substep(0.04, 5.0, thickness=1.0) == pytest.approx(0.02 / 5.0)
    thin = longest_travel_substep(0.04, 5.0, thickness=0.001)
    assert 0.0005 / 5.0 < thin < 0.01 / 5.0
