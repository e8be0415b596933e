import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.sim.sph.boundary import ObstacleRanges
from nmpm.sim.sph.layouts import Column, FluidBlocks, relax

BOX = ((0.1, 0.9), (0.2, 0.8))
COLUMN = Column(width=0.3, height=0.2, noise=0.25, relaxation=100)
THROW = FluidBlocks((1, 3), (400, 500), 0.2, (0.5, 2.0), 0.02, 1.0, 0.1)
STREWN = ObstacleRanges((1, 3), (0.06, 0.1), 0.02)


def nearest(position):
    return cKDTree(position).query(position, k=2)[0][:, 1]


def draw(start, seed, obstacles=()):
    return start.draw(BOX, 0.01, obstacles, np.random.default_rng(seed))


def test_a_column_fills_its_corner_evenly():
    position, velocity = draw(COLUMN, 0)
    assert position.shape == (600, 2)
    assert not velocity.any()
    assert np.all((position > [0.1, 0.2]) & (position < [0.4, 0.4]))
    assert np.percentile(nearest(position), 5) > 0.007
    halves = position[:, 0] < 0.25, position[:, 1] < 0.3
    assert all(half.sum() == pytest.approx(300, abs=10) for half in halves)


def test_relaxation_spreads_random_particles():
    rng = np.random.default_rng(0)
    scattered = rng.uniform(0, 1, (400, 2))
    box = ((0.0, 1.0), (0.0, 1.0))
    evenness = [np.percentile(nearest(relax(scattered, box, 0.05, sweeps)), 5) for sweeps in (0, 30, 300)]
    assert evenness[0] < evenness[1] < evenness[2]
    assert evenness[2] > 0.6 * 0.05


def test_a_lattice_is_relaxed_already():
    nodes = np.stack(np.meshgrid(np.arange(20), np.arange(10), indexing="ij"), -1).reshape(-1, 2)
    lattice = 0.05 * (nodes + 0.5)
    np.testing.assert_allclose(relax(lattice, ((0.0, 1.0), (0.0, 0.5)), 0.05, 20), lattice, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**63 - 1))
def test_blocks_and_obstacles_keep_to_the_preset(seed):
    obstacles = STREWN.draw(BOX, np.random.default_rng(seed))
    assert 1 <= len(obstacles) <= 3
    for k, obstacle in enumerate(obstacles):
        assert np.all((obstacle.corners > [0.12, 0.22]) & (obstacle.corners < [0.88, 0.78]))
        assert len(obstacle.corners) in (3, 4)
        assert obstacle.depth(obstacle.corners.mean(0)[None]) > 0, "The corners should run counter-clockwise."
        assert all(np.all(other.depth(obstacle.corners) < 0) for other in obstacles[:k])
    position, velocity = draw(THROW, seed, obstacles)
    assert len(position) <= 500
    assert np.all((position >= [0.12, 0.22]) & (position <= [0.88, 0.78]))
    assert np.abs(velocity).max() <= 1.0
    assert all(obstacle.depth(position).max() < -0.005 for obstacle in obstacles)
    assert nearest(position).min() > 0.8 * 0.01 - 1e-12
    speeds, block = np.unique(velocity, axis=0, return_inverse=True)
    for this in range(len(speeds)):
        mine, others = position[block.ravel() == this], position[block.ravel() != this]
        assert not len(others) or cKDTree(others).query(mine)[0].min() >= 0.02


def test_the_same_seed_draws_the_same():
    for start in (COLUMN, THROW):
        np.testing.assert_array_equal(draw(start, 3)[0], draw(start, 3)[0])
        assert not np.array_equal(draw(start, 3)[0][:300], draw(start, 4)[0][:300])


@pytest.mark.parametrize(
    ("crowded", "message"),
    [
        (FluidBlocks((1, 1), (9000, 9001), 0.2, (1.0, 1.0), 0.02, 1.0, 0.1), "No room"),
        (ObstacleRanges((9, 9), (0.3, 0.3), 0.1), "No"),
    ],
)
def test_a_box_too_crowded_is_an_error(crowded, message):
    with pytest.raises(ConfigError, match=message):
        crowded.draw(*((BOX, 0.01, ()) if isinstance(crowded, FluidBlocks) else (BOX,)), np.random.default_rng(0))
