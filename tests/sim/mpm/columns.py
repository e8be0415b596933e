"""Columns of material that stand on the floor, for tests of the simulators' physics."""

import numpy as np

from nmpm.sim.mpm.stepper import MpmGrid, MpmParticles, MpmStepper, Walls

GRAVITY = np.array([0.0, -9.81])


def lattice(low, high, spacing):
    """Centres of the squares that fill a rectangle."""
    low = np.asarray(low, float)
    counts = np.rint((np.asarray(high) - low) / spacing).astype(int)
    squares = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 2)
    return low + spacing * (squares + 0.5)


def at_rest(position, groups, size):
    """Four particles per cell, without velocity; groups as `MpmParticles` takes them."""
    return MpmParticles(position, np.zeros_like(position), groups, size**2 / 4)


def tank(width, height, size, wave_speed, gravity=GRAVITY, friction=0.0, walls=Walls.SEPARATE, cfl=0.3):
    """A stepper for the box from 0 to (width, height), whose walls begin exactly there."""
    rows = 1 if walls is Walls.SEPARATE else 3
    low = np.full(2, -0.5 * rows * size)
    shape = (round(width / size) + rows, round(height / size) + rows)
    return MpmStepper(MpmGrid(low, size, shape, friction, np.asarray(gravity, float), walls), cfl * size / wave_speed)


def run(stepper, state, seconds):
    """Substeps for at least so long; returns how long it was."""
    substeps = int(np.ceil(seconds / stepper.dt))
    for _ in range(substeps):
        stepper.step(state)
    return substeps * stepper.dt
