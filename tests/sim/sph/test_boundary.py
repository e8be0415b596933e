"""Walls and obstacles as dummy particles and surfaces, and the initial states drawn between them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.sim.sph.boundary import (
    LAYERS,
    ObstacleRanges,
    PolygonObstacle,
    SolidBoundary,
    box_particles,
    obstacle_particles,
)
from nmpm.sim.sph.preset import Column, FluidBlocks

SQUARE = PolygonObstacle(np.array([[0.4, 0.4], [0.6, 0.4], [0.6, 0.6], [0.4, 0.6]]))
TRIANGLE = PolygonObstacle(np.array([[0.3, 0.2], [0.8, 0.3], [0.7, 0.7]]))
UNIT = ((0.0, 1.0), (0.0, 1.0))
BOX = ((0.1, 0.9), (0.2, 0.8))
COLUMN = Column(width=0.3, height=0.2, noise=0.25, relaxation=100)
THROW = FluidBlocks((1, 3), (400, 500), 0.2, (0.5, 2.0), 0.02, 1.0, 0.1)
STREWN = ObstacleRanges((1, 3), (0.06, 0.1), 0.02)


def test_depth_and_distance_of_polygons():
    points = np.array([[0.5, 0.5], [0.41, 0.5], [0.4, 0.45], [0.3, 0.5], [0.9, 0.9]])
    np.testing.assert_allclose(SQUARE.distance(points), [-0.1, -0.01, 0.0, 0.1, 0.3], atol=1e-12)
    shift = np.array([3.0, -0.5])
    np.testing.assert_allclose(TRIANGLE.moved(shift).distance(points + shift), TRIANGLE.distance(points), atol=1e-12)


def test_box_particles_continue_the_lattice():
    position, layer = box_particles(((0.0, 1.0), (0.0, 0.5)), 0.05)
    inside = np.all((position > 0) & (position < [1.0, 0.5]), axis=1)
    assert not inside.any()
    assert len(position) == (20 + 2 * LAYERS) * (10 + 2 * LAYERS) - 20 * 10
    assert (layer == 0).sum() == 2 * (20 + 10) + 4
    np.testing.assert_allclose(cKDTree(position).query(position, k=2)[0][:, 1], 0.05)
    off = np.maximum(-position, position - [1.0, 0.5]).max(axis=1)
    np.testing.assert_allclose(off, 0.05 * (layer + 0.5))


@pytest.mark.parametrize("obstacle", [SQUARE, TRIANGLE])
def test_obstacle_particles_lie_in_rings_of_even_spacing(obstacle):
    spacing = 0.01
    points = obstacle_particles(obstacle, spacing)
    depth = -obstacle.distance(points)
    rings = np.round(depth / spacing - 0.5)
    np.testing.assert_allclose(depth, spacing * (rings + 0.5), atol=1e-9)
    assert set(rings) == {0.0, 1.0, 2.0}
    gaps = cKDTree(points[rings == 0]).query(points[rings == 0], k=2)[0][:, 1]
    assert gaps.min() > 0.4 * spacing  # across an acute corner
    assert gaps.max() < 1.1 * spacing


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_clamped_particles_are_outside_of_solids_and_do_not_move_into_them(seed):
    rng = np.random.default_rng(seed)
    boundary = SolidBoundary(UNIT, (TRIANGLE,), 0.01)
    x, y = rng.uniform(-0.1, 1.1, (2, 50))
    vx, vy = rng.normal(size=(2, 50))
    before = np.stack([x, y, vx, vy], -1)
    crossed = boundary.count_outside(before[:, :2])
    held = boundary.clamp(x, y, vx, vy)
    assert boundary.count_outside(np.stack([x, y], -1).astype(np.float32)) == 0
    assert held >= crossed
    kept = np.all(before[:, :2] == np.stack([x, y], -1), axis=1)
    np.testing.assert_array_equal(np.stack([vx, vy], -1)[kept], before[kept, 2:])
    assert np.all(np.hypot(vx, vy) <= np.hypot(*before[:, 2:].T) + 1e-12)
    put = ~kept & (TRIANGLE.distance(before[:, :2]) < 0)
    edge = np.argmin(np.abs(TRIANGLE.offsets - np.stack([x, y], -1) @ TRIANGLE.normals.T), axis=1)
    along = (np.stack([vx, vy], -1) * TRIANGLE.normals[edge]).sum(-1)
    assert np.all(along[put] >= -1e-9)


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


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**63 - 1))
def test_blocks_and_obstacles_keep_to_the_preset(seed):
    obstacles = STREWN.draw(BOX, np.random.default_rng(seed))
    assert 1 <= len(obstacles) <= 3
    for k, obstacle in enumerate(obstacles):
        assert np.all((obstacle.corners > [0.12, 0.22]) & (obstacle.corners < [0.88, 0.78]))
        assert len(obstacle.corners) in (3, 4)
        assert obstacle.distance(obstacle.corners.mean(0)[None]) < 0, "The corners should run counter-clockwise."
        assert all(np.all(other.distance(obstacle.corners) > 0) for other in obstacles[:k])
    position, velocity = draw(THROW, seed, obstacles)
    assert len(position) <= 500
    assert np.all((position >= [0.12, 0.22]) & (position <= [0.88, 0.78]))
    assert np.abs(velocity).max() <= 1.0
    assert all(obstacle.distance(position).min() > 0.005 for obstacle in obstacles)
    assert nearest(position).min() > 0.8 * 0.01 - 1e-12
    speeds, block = np.unique(velocity, axis=0, return_inverse=True)
    for this in range(len(speeds)):
        mine, others = position[block.ravel() == this], position[block.ravel() != this]
        assert not len(others) or cKDTree(others).query(mine)[0].min() >= 0.02
