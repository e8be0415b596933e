"""Blocks and ramps of initial states."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.sim import load_preset
from nmpm.sim.mpm.layouts import RampRanges

GOOP = load_preset("goop")


RAMPS = RampRanges(number=(2, 4), length=(0.1, 0.3), thickness=0.03, angle=(10.0, 50.0), gap=0.05)
BOX = ((0.1, 0.9), (0.1, 0.9))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**63 - 1))
def test_blocks_keep_to_the_preset(seed):
    start = GOOP.draw(seed)
    low, high = np.array(GOOP.box).T
    gap, slack = GOOP.blocks.gap, GOOP.spacing * (0.5 - GOOP.blocks.jitter)
    assert 1700 <= len(start.position) == sum(start.counts) <= 2000
    assert np.all(start.position >= low + gap + slack - 1e-12)
    assert np.all(start.position <= high - gap - slack + 1e-12)
    assert np.abs(start.velocity).max() <= GOOP.blocks.speed
    velocities, block = np.unique(start.velocity, axis=0, return_inverse=True)
    assert 1 <= len(velocities) <= 3
    nearest = cKDTree(start.position).query(start.position, k=2)[0][:, 1]
    assert nearest.min() >= (1 - 2 * GOOP.blocks.jitter) * GOOP.spacing - 1e-12
    for this in range(len(velocities)):
        others = start.position[block.ravel() != this]
        if len(others):
            apart = cKDTree(others).query(start.position[block.ravel() == this])[0]
            assert apart.min() >= gap


@given(seed=st.integers(0, 2**32), low=st.tuples(st.floats(0.15, 0.5), st.floats(0.4, 0.6)))
@settings(max_examples=15, deadline=None)
def test_drawn_bars_keep_their_distance_from_everything(seed, low):
    block = np.array(low), np.array(low) + 0.2
    drawn = RAMPS.draw(BOX, [block], np.random.default_rng(seed))
    assert 2 <= len(drawn) <= 4
    grid = np.stack(np.meshgrid(*np.linspace(*block, 30).T, indexing="ij"), -1).reshape(-1, 2)
    for index, ramp in enumerate(drawn):
        outline = ramp.outline()
        assert np.all((outline >= 0.15 - 1e-9) & (outline <= 0.85 + 1e-9))
        assert ramp.distance(grid).min() >= 0.05 - 2e-3
        assert 10 <= abs(math.degrees(ramp.angle)) <= 50
        for other in drawn[:index]:
            assert other.distance(outline).min() >= 0.05 - 1e-9
    assert sum(len(ramp.particles(0.01)) for ramp in drawn) <= RAMPS.max_particles(0.01)


def test_slabs_keep_their_distance_in_three_dimensions():
    ranges = dataclasses.replace(RAMPS, width=(0.1, 0.4))
    block = np.array([0.4, 0.4, 0.4]), np.array([0.6, 0.6, 0.6])
    inside = np.stack(np.meshgrid(*np.linspace(*block, 12).T, indexing="ij"), -1).reshape(-1, 3)
    for seed in range(5):
        drawn = ranges.draw((*BOX, (0.1, 0.9)), [block], np.random.default_rng(seed))
        for ramp in drawn:
            points = ramp.particles(0.01)
            assert len(points) == round(ramp.length / 0.01) * 3 * round(ramp.width / 0.01)
            assert ramp.distance(points).max() < 0
            assert np.all((points >= 0.15) & (points <= 0.85))
            assert ramp.distance(inside).min() >= 0.04
            assert all(other is ramp or other.distance(points).min() >= 0.04 for other in drawn)
        assert len({round(ramp.turn, 6) for ramp in drawn}) == len(drawn)
        assert sum(len(ramp.particles(0.01)) for ramp in drawn) <= ranges.max_particles(0.01)


@pytest.mark.slow
def test_a_box_too_crowded_is_an_error():
    crowded = dataclasses.replace(GOOP, blocks=dataclasses.replace(GOOP.blocks, particles=(20_000, 21_000)))
    with pytest.raises(ConfigError, match="No room"):
        crowded.draw(0)
    with pytest.raises(ConfigError, match="No room for 20 ramps"):
        dataclasses.replace(RAMPS, number=(20, 20), gap=0.2).draw(BOX, [], np.random.default_rng(0))
