import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.sim.sph.boundary import LAYERS, PolygonObstacle, SolidBoundary, box_particles, obstacle_particles

SQUARE = PolygonObstacle(np.array([[0.4, 0.4], [0.6, 0.4], [0.6, 0.6], [0.4, 0.6]]))
RAMP = PolygonObstacle(np.array([[0.3, 0.2], [0.8, 0.3], [0.7, 0.7]]))
BOX = ((0.0, 1.0), (0.0, 1.0))


def test_depth_of_a_square():
    points = np.array([[0.5, 0.5], [0.41, 0.5], [0.4, 0.45], [0.3, 0.5], [0.9, 0.9]])
    np.testing.assert_allclose(SQUARE.depth(points), [0.1, 0.01, 0.0, -0.1, -0.3], atol=1e-12)


def test_box_particles_continue_the_lattice():
    position, layer = box_particles(((0.0, 1.0), (0.0, 0.5)), 0.05)
    inside = np.all((position > 0) & (position < [1.0, 0.5]), axis=1)
    assert not inside.any()
    assert len(position) == (20 + 2 * LAYERS) * (10 + 2 * LAYERS) - 20 * 10
    assert (layer == 0).sum() == 2 * (20 + 10) + 4
    np.testing.assert_allclose(cKDTree(position).query(position, k=2)[0][:, 1], 0.05)
    off = np.maximum(-position, position - [1.0, 0.5]).max(axis=1)
    np.testing.assert_allclose(off, 0.05 * (layer + 0.5))


@pytest.mark.parametrize("obstacle", [SQUARE, RAMP])
def test_obstacle_particles_lie_in_rings_of_even_spacing(obstacle):
    spacing = 0.01
    points = obstacle_particles(obstacle, spacing)
    depth = obstacle.depth(points)
    rings = np.round(depth / spacing - 0.5)
    np.testing.assert_allclose(depth, spacing * (rings + 0.5), atol=1e-9)
    assert set(rings) == {0.0, 1.0, 2.0}
    gaps = cKDTree(points[rings == 0]).query(points[rings == 0], k=2)[0][:, 1]
    assert gaps.min() > 0.4 * spacing  # across an acute corner
    assert gaps.max() < 1.1 * spacing


def test_a_thin_obstacle_has_fewer_rings():
    plank = PolygonObstacle(np.array([[0.2, 0.5], [0.8, 0.5], [0.8, 0.518], [0.2, 0.518]]))
    depth = plank.depth(obstacle_particles(plank, 0.01))
    np.testing.assert_allclose(depth, 0.005, atol=1e-9)


def test_particles_of_overlapping_obstacles_are_not_doubled():
    boundary = SolidBoundary(BOX, (SQUARE, RAMP), 0.01)
    own = boundary.position[SQUARE.depth(boundary.position) > 0]
    assert len(own) == len(obstacle_particles(SQUARE, 0.01))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_clamped_particles_are_outside_of_solids_and_do_not_move_into_them(seed):
    rng = np.random.default_rng(seed)
    boundary = SolidBoundary(BOX, (RAMP,), 0.01)
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
    put = ~kept & (RAMP.depth(before[:, :2]) > 0)
    edge = np.argmin(np.abs(RAMP.offsets - np.stack([x, y], -1) @ RAMP.normals.T), axis=1)
    along = (np.stack([vx, vy], -1) * RAMP.normals[edge]).sum(-1)
    assert np.all(along[put] >= -1e-9)


def test_visible_particles_are_the_first_layer_and_the_obstacles():
    boundary = SolidBoundary(BOX, (SQUARE,), 0.05)
    shown = boundary.position[boundary.visible]
    outside = np.any((shown < 0) | (shown > 1), axis=1)
    assert outside.sum() == 4 * 20 + 4
    assert np.all(SQUARE.depth(shown[~outside]) > 0)
    assert math.isclose(np.abs(shown[outside] - 0.5).max(), 0.525)


def test_a_moved_polygon_is_as_far_from_moved_points():
    triangle = PolygonObstacle(np.array([[0.0, 0.0], [0.4, 0.1], [0.1, 0.5]]))
    points, shift = np.random.default_rng(0).uniform(-1, 1, (50, 2)), np.array([3.0, -0.5])
    np.testing.assert_allclose(triangle.moved(shift).distance(points + shift), triangle.distance(points), atol=1e-12)
