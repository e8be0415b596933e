"""Water at rest, and water let go, against closed forms."""

import numpy as np
import pytest
from columns import at_rest, lattice, run, tank

from nmpm.sim.mpm.water import Water

WATER = Water(density=1000.0, bulk_modulus=7e4)
WEIGHT = 1000.0 * 9.81


@pytest.mark.parametrize(("size", "tolerance"), [(0.025, 0.12), (0.0125, 0.06)])
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


@pytest.fixture(scope="module")
def dam_break():
    """A long reservoir on dry ground, at 2.5 and at 3.5 of its own time scale √(h₀/g); times and positions."""
    size, deep, back = 0.0125, 0.2, 1.0
    position = lattice((0, 0), (back, deep), size / 2)
    state = at_rest(position, ((WATER, len(position)),), size)
    state.strain[:, 0] = 1 - WEIGHT * (deep - position[:, 1]) / WATER.bulk_modulus
    stepper = tank(2.6, 0.25, size, WATER.wave_speed)
    unit = np.sqrt(deep / 9.81)
    time = run(stepper, state, 2.5 * unit)
    early = time, state.position - [back, 0.0]
    time += run(stepper, state, 1.0 * unit)
    return deep, early, (time, state.position - [back, 0.0])


def depths(position, edges, deep, size=0.0125):
    return np.histogram(position[:, 0], edges)[0] * size**2 / 4 / np.diff(edges) / deep


def test_a_broken_dam_takes_ritters_shape(dam_break):
    """h = (2 c − x / t)² / 9 g between −c t and 2 c t, c = √(g h₀); Ritter, 1892."""
    deep, _, (time, position) = dam_break
    speed = np.sqrt(9.81 * deep)
    edges = np.linspace(-1.0, 1.5, 51)
    centres = (edges[1:] + edges[:-1]) / 2
    ritter = np.clip(2 - centres / (speed * time), 0, 3) ** 2 / 9
    assert np.sqrt(np.mean((depths(position, edges, deep) - ritter) ** 2)) < 0.05


def test_the_depth_at_the_dam_is_four_ninths(dam_break):
    deep, _, (_, position) = dam_break
    assert depths(position, np.array([-0.04, 0.04]), deep)[0] == pytest.approx(4 / 9, rel=0.1)


def test_the_front_runs_nearly_as_fast_as_ritters(dam_break):
    """Twice c for shallow water, which the front, deep for its length and starting from rest, only approaches."""
    deep, (early, near), (late, far) = dam_break
    fronts = [np.percentile(position[:, 0], 99.8) for position in (near, far)]
    ratio = (fronts[1] - fronts[0]) / (late - early) / (2 * np.sqrt(9.81 * deep))
    assert 0.8 < ratio <= 1.0
