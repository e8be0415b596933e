"""Standing waves in a column against their closed form: period, and convergence as the grid is refined."""

import numpy as np
import pytest
from columns import at_rest, lattice, tank

from nmpm.sim.mpm.solids import Goop
from nmpm.sim.mpm.stepper import Walls
from nmpm.sim.mpm.water import Water

WATER = Water(density=1000.0, bulk_modulus=7e4)
JELLY = Goop(density=1000.0, young=4e5, poisson=0.3, yield_stress=1e9, viscosity=1e9)
HEIGHT, WIDTH = 0.4, 0.1


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
def test_a_column_swings_with_the_period_of_its_wave_speed(material):
    time, amplitude = oscillate(material, 0.0125)
    turns = np.nonzero(np.diff(np.sign(amplitude)))[0]
    assert 2 * (time[turns[1]] - time[turns[0]]) == pytest.approx(1.0, abs=0.02)
    assert amplitude[-1] == pytest.approx(1.0, abs=0.03), "It should hardly lose anything in one period."


@pytest.mark.parametrize("material", [WATER, JELLY], ids=lambda m: m.name)
def test_finer_grids_converge_at_first_order(material):
    """The free surface is known to half a cell, which is what limits the order."""
    errors = []
    for size in (0.025, 0.0125, 0.00625):
        time, amplitude = oscillate(material, size)
        errors.append(np.sqrt(np.mean((amplitude - np.cos(2 * np.pi * time)) ** 2)))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 0.75), f"errors {errors}"
    assert errors[-1] < 0.02
