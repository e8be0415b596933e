import dataclasses

import numpy as np
import pytest

from nmpm.viz.camera import camera_for
from nmpm.viz.colours import INTERIOR, OBSTACLE, WALL, colour
from nmpm.viz.panel import Panel
from nmpm.viz.spacing import particle_spacing


def first_frame(exhibit):
    return next(iter(exhibit.rows.values()))[0]


def test_particles_have_their_colour_at_their_place(falling):
    panel = Panel(falling, 200)
    image = panel.draw(first_frame(falling))
    assert image.shape == (200, 200, 3)
    assert tuple(image[panel.pixel(np.array([0.3, 0.8]))]) == colour("water")
    sand = image[panel.pixel(np.array([0.7, 0.8]))].astype(int)
    assert np.abs(sand - colour("sand")).max() < 45
    assert tuple(image[panel.pixel(np.array([0.5, 0.5]))]) == INTERIOR
    assert tuple(image[panel.pixel(np.array([0.09, 0.5]))]) == WALL


def test_the_pixel_of_a_point_follows_from_the_box(falling):
    rim = 0.008 * 0.84
    row, column = Panel(falling, 300).pixel(np.array([0.3, 0.8]))
    assert column == pytest.approx((0.3 - 0.08 + rim) / (0.84 + 2 * rim) * 300, abs=1)
    assert row == pytest.approx((0.92 + rim - 0.8) / (0.84 + 2 * rim) * 300, abs=1)


def test_y_points_up(still):
    image = Panel(still([[0.5, 0.85]], ["goop"]), 200).draw(np.array([[0.5, 0.85]])).astype(int)
    rows = np.flatnonzero((np.abs(image - colour("goop")).max(axis=2) < 10).any(axis=1))
    assert rows.size
    assert rows.max() < 40


def test_a_wide_box_keeps_its_proportions(still):
    assert Panel(still([[1, 1]], ["water"], bounds=((0, 4), (0, 2))), 400).height == pytest.approx(200, abs=4)


def test_motion_below_a_pixel_shows(falling):
    panel = Panel(falling, 200)
    start = first_frame(falling)
    assert (panel.draw(start) != panel.draw(start + 0.4 * 0.84 / 200)).any()


def test_obstacles_are_drawn(still):
    exhibit = still([[0.5, 0.5]], ["water"], obstacle=np.array([[0.2, 0.3]]))
    panel = Panel(exhibit, 200)
    assert tuple(panel.draw(first_frame(exhibit))[panel.pixel(np.array([0.2, 0.3]))]) == OBSTACLE


def test_particles_out_of_view_are_counted_and_harmless(falling):
    panel = Panel(falling, 200)
    gone = np.array([[0.3, 0.8], [1e30, -1e30]])
    assert panel.outside(first_frame(falling)) == 0
    assert panel.outside(gone) == 1
    assert tuple(panel.draw(gone)[panel.pixel(gone[0])]) == colour("water")


def test_particles_wrap_along_a_periodic_axis(falling):
    exhibit = dataclasses.replace(falling, periodic=(True, False), domain=None)
    panel = Panel(exhibit, 200)
    away = first_frame(exhibit) + np.array([1.6, 0])
    assert panel.outside(away) == 0
    np.testing.assert_array_equal(panel.draw(away), panel.draw(first_frame(exhibit)))


def test_in_3d_the_nearer_particle_hides_the_farther(still):
    exhibit = still([[0.5, 0.5, 0.5]] * 2, ["water", "sand"])
    toward = camera_for(exhibit).axes[2]
    middle = np.full(3, 0.5)
    panel = Panel(exhibit, 200)
    for sign, nearer in ((1, 0), (-1, 1)):
        image = panel.draw(np.stack([middle + sign * 0.2 * toward, middle - sign * 0.2 * toward]))
        shown = image[panel.pixel(middle)].astype(int)
        blue_over_red = shown[2] > shown[0]
        assert blue_over_red == (nearer == 0)


@pytest.mark.parametrize(("gravity", "up"), [(None, 1), ((0.0, 0.0, -9.81), 2), ((0.0, -9.81, 0.0), 1)])
def test_in_3d_gravity_points_down(still, gravity, up):
    exhibit = still([[0.5, 0.5, 0.5]], ["water"], gravity=gravity)
    axes = camera_for(exhibit).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[0, up] == pytest.approx(0)
    assert axes[1, up] > 0.9
    panel = Panel(exhibit, 200)
    assert panel.pixel(np.full(3, 0.5) + 0.2 * np.eye(3)[up])[0] < panel.pixel(np.full(3, 0.5))[0]


def test_in_3d_the_whole_box_is_in_view(still):
    exhibit = still([[0.5, 0.5, 0.5]], ["water"])
    corners = np.stack(np.meshgrid([0.1, 0.9], [0.1, 0.9], [0.1, 0.9]), axis=-1).reshape(-1, 3)
    assert Panel(exhibit, 200).outside(corners) == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_spacing_of_a_lattice_is_its_own(dim):
    axis = 0.01 * np.arange(12)
    lattice = np.stack(np.meshgrid(*[axis] * dim), axis=-1).reshape(-1, dim)
    assert particle_spacing(lattice) == pytest.approx(0.01, rel=0.05 if dim == 2 else 0.12)


@pytest.mark.parametrize("dim", [2, 3])
def test_spacing_of_random_particles_is_the_mean_one(dim):
    points = np.random.default_rng(0).uniform(size=(4000, dim))
    assert particle_spacing(points) == pytest.approx(4000 ** (-1 / dim), rel=0.1)


def test_a_lone_particle_is_drawn(still):
    assert particle_spacing(np.zeros((1, 2))) == np.inf
    exhibit = still([[0.5, 0.5]], ["water"])
    assert (Panel(exhibit, 100).draw(first_frame(exhibit)) == colour("water")).all(axis=2).sum() > 100
