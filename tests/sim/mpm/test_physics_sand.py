"""Heaps of sand."""

import numpy as np
import pytest
from columns import at_rest, lattice, run, tank

from nmpm.sim.mpm.solids import Sand

SIZE = 0.0125
ANGLES = (20.0, 30.0, 40.0)


def collapse(angle):
    """Distance from the middle and height of the particles of a column that has come to rest."""
    sand = Sand(density=1000.0, young=1e5, poisson=0.3, friction_angle=angle)
    position = lattice((0.375, 0), (0.525, 0.2), SIZE / 2)
    state = at_rest(position, ((sand, len(position)),), SIZE)
    run(tank(0.9, 0.3, SIZE, sand.wave_speed, friction=0.6, cfl=0.5), state, 1.2)
    assert np.abs(state.velocity).max() < 0.02
    return np.abs(state.position[:, 0] - 0.45), state.position[:, 1]


@pytest.fixture(scope="module")
def heaps():
    return {angle: collapse(angle) for angle in ANGLES}


def slope(away, height):
    """Of the surface where the heap is at least a quarter as high as at its top, in degrees."""
    bins = np.arange(0, 0.45, SIZE)
    surface = np.array([height[(away >= a) & (away < a + SIZE)].max(initial=0) for a in bins])
    there = surface > surface.max() / 4
    return np.degrees(np.arctan(-np.polyfit(bins[there], surface[there], 1)[0]))


def test_the_angle_of_repose_grows_with_friction(heaps):
    slopes = [slope(*heaps[angle]) for angle in ANGLES]
    assert slopes[0] + 2 < slopes[1]
    assert slopes[1] + 2 < slopes[2]


def test_a_heap_is_never_steeper_than_its_friction_angle(heaps):
    assert all(slope(*heaps[angle]) < angle for angle in ANGLES)


def test_a_rougher_sand_runs_out_less_far(heaps):
    reach = [np.percentile(heaps[angle][0], 99) for angle in ANGLES]
    assert reach[0] > 1.1 * reach[1] > 1.21 * reach[2]


def test_a_heap_keeps_its_area(heaps):
    away, height = heaps[30.0]
    bins = np.arange(0, 0.45, SIZE)
    surface = np.array([height[(away >= a) & (away < a + SIZE)].max(initial=0) for a in bins])
    assert 2 * SIZE * surface.sum() == pytest.approx(0.15 * 0.2, rel=0.15)
