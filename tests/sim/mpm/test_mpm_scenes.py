"""Trajectories of the material point method: beside others' recordings, at rest, and on coarser grids."""

import dataclasses

import h5py
import numpy as np
import pytest

from nmpm.sim import InitialState, load_preset
from nmpm.sim.mpm.materials import Sand, Water

GOOP = load_preset("goop")


# What DeepMind's water was made with, as far as its recordings tell.
WATERDROP = dataclasses.replace(
    load_preset("goop"),
    box=((0.1, 0.9), (0.1, 0.9)),
    cells=80,
    substeps=25,
    wall_friction=0.0,
    walls="slip, open corners",
    materials=(Water(density=1000.0, bulk_modulus=7e4),),
)


ELEMENTS = dataclasses.replace(
    WATERDROP, box=((0.09375, 0.90625),) * 2, cells=52, substeps=9, walls="slip", wall_friction=0.3
)


def errors(preset, path, frames):
    """Mean squared distance over the frames after the second, for each trajectory of a file; and of nothing moving."""
    pairs = []
    with h5py.File(path) as file:
        for group in file.values():
            position = group["position"][: frames + 2].astype(np.float64)
            half_a_kick = preset.frame_dt / 2 * (1 - 1 / preset.substeps) * np.array(preset.gravity)
            velocity = (position[1] - position[0]) / preset.frame_dt + half_a_kick
            made = preset.simulate_from(InitialState(position[1], velocity), frames)
            assert made.attributes["held_back"] == 0
            pairs.append([np.mean((made.position[1:] - position[2:]) ** 2), np.mean((position[1] - position[2:]) ** 2)])
    return np.array(pairs).T


@pytest.mark.slow
def test_water_follows_deepminds_with_open_corners(recorded):
    ours, still = errors(WATERDROP, recorded / "deepmind-waterdrop" / "test.h5", 300)
    assert np.all(still > 30e-3)
    assert np.all(ours < 0.05e-3)
    closed = dataclasses.replace(WATERDROP, walls="slip")
    assert errors(closed, recorded / "deepmind-waterdrop" / "valid.h5", 300)[0].mean() > 3 * ours.mean()


@pytest.mark.slow
def test_sand_follows_taichi_elements(recorded):
    """Their friction angle of 40 degrees is that of triaxial tests: in plane strain their cone is one of 39."""
    preset = dataclasses.replace(
        ELEMENTS, materials=(Sand(density=1800.0, young=1e6, poisson=0.2, friction_angle=38.98),)
    )
    ours, still = errors(preset, recorded / "taichi-elements-2d" / "sand" / "test.h5", 200)
    assert np.all(still > 20e-3)
    assert ours.mean() < 0.02e-3


def test_water_follows_taichi_elements(recorded):
    linear = Water(density=1800.0, bulk_modulus=1e6 * 0.2 / (1.2 * 0.6), exponent=-1.0)
    preset = dataclasses.replace(ELEMENTS, materials=(linear,), wall_friction=0.0)
    ours, still = errors(preset, recorded / "taichi-elements-2d" / "water" / "test.h5", 150)
    assert np.all(still > 20e-3)
    assert ours.mean() < 0.02e-3


def test_walls_that_hold_let_particles_a_cell_and_a_half_beyond_the_box():
    np.testing.assert_allclose(WATERDROP.reach, [[0.085, 0.915]] * 2)
    assert WATERDROP.scene.bounds == WATERDROP.reach
    assert dataclasses.replace(WATERDROP, walls="separate").reach == WATERDROP.box
    deepest = np.array([[0.1, 0.086], [0.5, 0.0915]])
    assert WATERDROP.simulate_from(InitialState(deepest, np.zeros((2, 2))), 5).position.min() > 0.085
