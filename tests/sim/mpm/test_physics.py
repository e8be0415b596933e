"""Heaps, tanks, broken dams and waves against closed forms."""

import numpy as np
import pytest
from columns import at_rest, lattice, run, tank

from nmpm.sim.mpm.materials import Goop, Sand, Water
from nmpm.sim.mpm.stepper import Walls

SIZE = 0.0125
ANGLES = (20.0, 30.0, 40.0)
WATER = Water(density=1000.0, bulk_modulus=7e4)
WEIGHT = 1000.0 * 9.81
JELLY = Goop(density=1000.0, young=4e5, poisson=0.3, yield_stress=1e9, viscosity=1e9)
HEIGHT, WIDTH = 0.4, 0.1


def collapse(angle):
    """Distance from the middle and height of the particles of a column that has come to rest."""
    sand = Sand(density=1000.0, young=1e5, poisson=0.3, friction_angle=angle)
    position = lattice((0.375, 0), (0.525, 0.2), SIZE / 2)
    state = at_rest(position, ((sand, len(position)),), SIZE)
    run(tank(0.9, 0.3, SIZE, sand.wave_speed, friction=0.6, cfl=0.5), state, 1.2)
    assert np.abs(state.velocity).max() < 0.02
    return np.abs(state.position[:, 0] - 0.45), state.position[:, 1]


def slope(away, height):
    """Of the surface where the heap is at least a quarter as high as at its top, in degrees."""
    bins = np.arange(0, 0.45, SIZE)
    surface = np.array([height[(away >= a) & (away < a + SIZE)].max(initial=0) for a in bins])
    there = surface > surface.max() / 4
    return np.degrees(np.arctan(-np.polyfit(bins[there], surface[there], 1)[0]))


@pytest.mark.slow
def test_heaps_of_rougher_sand_are_steeper_up_to_the_friction_angle_and_keep_their_area():
    heaps = {angle: collapse(angle) for angle in ANGLES}
    slopes = [slope(*heaps[angle]) for angle in ANGLES]
    assert slopes[0] + 2 < slopes[1]
    assert slopes[1] + 2 < slopes[2]
    assert all(steepness < angle for steepness, angle in zip(slopes, ANGLES, strict=True))
    reach = [np.percentile(heaps[angle][0], 99) for angle in ANGLES]
    assert reach[0] > 1.1 * reach[1] > 1.21 * reach[2]
    away, height = heaps[30.0]
    bins = np.arange(0, 0.45, SIZE)
    surface = np.array([height[(away >= a) & (away < a + SIZE)].max(initial=0) for a in bins])
    assert 2 * SIZE * surface.sum() == pytest.approx(0.15 * 0.2, rel=0.15)


@pytest.mark.parametrize(("size", "tolerance"), [(0.025, 0.12), pytest.param(0.0125, 0.06, marks=pytest.mark.slow)])
def test_pressure_at_rest_grows_with_depth(size, tolerance):
    """In proportion to the depth, with an error that halves with the cells."""
    width, height = 0.2, 0.3
    position = lattice((0, 0), (width, height), size / 2)
    state = at_rest(position, ((WATER, len(position)),), size)
    stepper = tank(width, 0.4, size, WATER.wave_speed)
    for _ in range(int(1.0 / stepper.dt)):
        stepper.step(state)
        state.velocity *= 0.995  # brings it to rest sooner than its own losses would
    pressure = np.array([WATER.pressure(volume) for volume in state.strain[:, 0]])
    layer = np.digitize(state.position[:, 1], np.linspace(0, 0.25, 6)) - 1
    heights = np.array([state.position[layer == k, 1].mean() for k in range(5)])
    means = np.array([pressure[layer == k].mean() for k in range(5)])
    slope, at_floor = np.polyfit(heights, means, 1)
    assert -slope == pytest.approx(WEIGHT, rel=tolerance)
    assert -at_floor / slope == pytest.approx(height, rel=0.05), "No pressure at the surface."
    assert means == pytest.approx(at_floor + slope * heights, abs=0.02 * at_floor)


def depths(position, edges, deep, size=0.0125):
    return np.histogram(position[:, 0], edges)[0] * size**2 / 4 / np.diff(edges) / deep


@pytest.mark.slow
def test_a_broken_dam_takes_ritters_shape():
    """h = (2 c − x / t)² / 9 g between −c t and 2 c t, c = √(g h₀), in a long reservoir on dry ground; Ritter, 1892.

    The front, deep for its length and starting from rest, only approaches twice c.
    """
    size, deep, back = SIZE, 0.2, 1.0
    position = lattice((0, 0), (back, deep), size / 2)
    state = at_rest(position, ((WATER, len(position)),), size)
    state.strain[:, 0] = 1 - WEIGHT * (deep - position[:, 1]) / WATER.bulk_modulus
    stepper = tank(2.6, 0.25, size, WATER.wave_speed)
    unit, speed = np.sqrt(deep / 9.81), np.sqrt(9.81 * deep)
    early = run(stepper, state, 2.5 * unit)
    near = np.percentile(state.position[:, 0], 99.8)
    late = early + run(stepper, state, 1.0 * unit)
    position = state.position - [back, 0.0]
    edges = np.linspace(-1.0, 1.5, 51)
    ritter = np.clip(2 - (edges[1:] + edges[:-1]) / 2 / (speed * late), 0, 3) ** 2 / 9
    assert np.sqrt(np.mean((depths(position, edges, deep) - ritter) ** 2)) < 0.05
    assert depths(position, np.array([-0.04, 0.04]), deep)[0] == pytest.approx(4 / 9, rel=0.1)
    assert 0.8 < (np.percentile(state.position[:, 0], 99.8) - near) / (late - early) / (2 * speed) <= 1.0


def oscillate(material, size):
    """Amplitude over time, in periods of the closed form: a quarter wave between a held floor and a free surface."""
    position = lattice((0, 0), (WIDTH, HEIGHT), size / 2)
    state = at_rest(position, ((material, len(position)),), size)
    mode = np.sin(np.pi * position[:, 1] / (2 * HEIGHT))
    first = 1e-3 * material.wave_speed
    state.velocity[:, 1] = first * mode
    stepper = tank(WIDTH, 1.25 * HEIGHT, size, material.wave_speed, gravity=(0.0, 0.0), walls=Walls.SLIP, cfl=0.25)
    period = 4 * HEIGHT / material.wave_speed
    amplitudes = []
    for _ in range(int(period / stepper.dt)):
        stepper.step(state)
        amplitudes.append(2 * np.mean(state.velocity[:, 1] * mode) / first)
    return stepper.dt / period * np.arange(1, len(amplitudes) + 1), np.array(amplitudes)


@pytest.mark.parametrize("material", [WATER, JELLY], ids=lambda m: m.name)
def test_a_column_swings_with_the_period_of_its_wave_speed_and_converges_at_first_order(material):
    """The free surface is known to half a cell, which is what limits the order."""
    errors = []
    for size in (0.025, 0.0125):
        time, amplitude = oscillate(material, size)
        errors.append(np.sqrt(np.mean((amplitude - np.cos(2 * np.pi * time)) ** 2)))
    turns = np.nonzero(np.diff(np.sign(amplitude)))[0]
    assert 2 * (time[turns[1]] - time[turns[0]]) == pytest.approx(1.0, abs=0.02)
    assert amplitude[-1] == pytest.approx(1.0, abs=0.03), "It should hardly lose anything in one period."
    assert np.log2(errors[0] / errors[1]) > 0.75, f"errors {errors}"
