"""Beside JAX-SPH's dam break, from its own first frame; `benchmarks/dam_break.py` compares to the end."""

import h5py
import numpy as np
import pytest

from nmpm.sim import InitialState, load_preset
from nmpm.sim.sph.boundary import SolidBoundary

FRAMES = 60


@pytest.fixture(scope="module")
def preset():
    return load_preset("dambreak2d")


@pytest.fixture(scope="module")
def theirs(recorded):
    with h5py.File(recorded / "jaxsph-dambreak-2d" / "test.h5") as file:
        kinds = file["00000/particle_type"][:]
        position = file["00000/position"][: FRAMES + 1].astype(np.float64)
    return position[:, kinds == 0], position[0, kinds == 1]


@pytest.fixture(scope="module")
def ours(theirs, preset):
    start = theirs[0][0]
    return preset.simulate_from(InitialState(start, np.zeros_like(start)), FRAMES).position.astype(np.float64)


def energy(water, dt):
    return 0.5 * (np.gradient(water, dt, axis=0) ** 2).sum(axis=(1, 2))


def test_walls_are_where_the_recordings_are(preset, theirs):
    boundary = SolidBoundary(preset.box, (), preset.spacing)
    mine = boundary.position[boundary.visible]
    np.testing.assert_allclose(
        mine[np.lexsort(mine.round(3).T)], theirs[1][np.lexsort(theirs[1].round(3).T)], atol=1e-5
    )


def test_every_particle_moves_as_theirs_until_the_wave_is_far_out(ours, theirs, preset):
    water = ours[:, : theirs[0].shape[1]]
    apart = np.sqrt(((water - theirs[0]) ** 2).sum(-1).mean(-1))
    assert apart[-1] < 0.1 * preset.spacing
    front = water[..., 0].max(1) / theirs[0][..., 0].max(1)
    np.testing.assert_allclose(front, 1.0, atol=0.005)
    np.testing.assert_allclose(energy(water, 0.03)[5:], energy(theirs[0], 0.03)[5:], rtol=0.02)
