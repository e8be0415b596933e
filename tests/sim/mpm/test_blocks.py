import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.sim import load_preset

GOOP = load_preset("goop")


@settings(max_examples=40, deadline=None)
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


def test_every_number_of_blocks_is_drawn_about_as_often():
    drawn = [len(np.unique(GOOP.draw(s).velocity, axis=0)) for s in range(150)]
    assert np.bincount(drawn)[1:].min() > 30


def test_a_box_too_crowded_is_an_error():
    crowded = dataclasses.replace(GOOP, blocks=dataclasses.replace(GOOP.blocks, particles=(20_000, 21_000)))
    with pytest.raises(ConfigError, match="No room"):
        crowded.draw(0)
