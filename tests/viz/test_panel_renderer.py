import dataclasses

import numpy as np
import pytest

from nmpm.viz.camera import fit_camera
from nmpm.viz.colours import INTERIOR, OBSTACLE, WALL, material_colour
from nmpm.viz.panel_renderer import PanelRenderer
from nmpm.viz.spacing import particle_spacing


def first_frame(trajectories):
    return next(iter(trajectories.positions.values()))[0]


def test_particles_are_drawn_at_their_position_in_their_colour(falling):
    panel = PanelRenderer(falling, 200)
    image = panel.draw(first_frame(falling))
    assert image.shape == (200, 200, 3)
    assert tuple(image[panel.pixel_of(np.array([0.3, 0.8]))]) == material_colour("water")
    sand = image[panel.pixel_of(np.array([0.7, 0.8]))].astype(int)
    assert np.abs(sand - material_colour("sand")).max() < 45
    assert tuple(image[panel.pixel_of(np.array([0.5, 0.5]))]) == INTERIOR
    assert tuple(image[panel.pixel_of(np.array([0.09, 0.5]))]) == WALL


def test_the_pixel_of_a_point_follows_from_the_box(falling):
    margin = 0.008 * 0.84
    row, column = PanelRenderer(falling, 300).pixel_of(np.array([0.3, 0.8]))
    assert column == pytest.approx((0.3 - 0.08 + margin) / (0.84 + 2 * margin) * 300, abs=1)
    assert row == pytest.approx((0.92 + margin - 0.8) / (0.84 + 2 * margin) * 300, abs=1)


def test_y_points_up(still):
    image = PanelRenderer(still([[0.5, 0.85]], ["goop"]), 200).draw(np.array([[0.5, 0.85]])).astype(int)
    rows = np.flatnonzero((np.abs(image - material_colour("goop")).max(axis=2) < 10).any(axis=1))
    assert rows.size
    assert rows.max() < 40


def test_a_wide_box_keeps_its_proportions(still):
    assert PanelRenderer(still([[1, 1]], ["water"], bounds=((0, 4), (0, 2))), 400).height == pytest.approx(200, abs=4)


def test_motion_smaller_than_a_pixel_is_visible(falling):
    panel = PanelRenderer(falling, 200)
    start = first_frame(falling)
    assert (panel.draw(start) != panel.draw(start + 0.4 * 0.84 / 200)).any()


def test_obstacles_are_drawn(still):
    trajectories = still([[0.5, 0.5]], ["water"], obstacle=np.array([[0.2, 0.3]]))
    panel = PanelRenderer(trajectories, 200)
    assert tuple(panel.draw(first_frame(trajectories))[panel.pixel_of(np.array([0.2, 0.3]))]) == OBSTACLE


def test_particles_out_of_view_are_counted_and_not_drawn(falling):
    panel = PanelRenderer(falling, 200)
    positions = np.array([[0.3, 0.8], [1e30, -1e30]])
    assert panel.count_outside(first_frame(falling)) == 0
    assert panel.count_outside(positions) == 1
    assert tuple(panel.draw(positions)[panel.pixel_of(positions[0])]) == material_colour("water")


def test_particles_wrap_along_a_periodic_axis(falling):
    trajectories = dataclasses.replace(falling, periodic=(True, False), domain=None)
    panel = PanelRenderer(trajectories, 200)
    away = first_frame(trajectories) + np.array([1.6, 0])
    assert panel.count_outside(away) == 0
    np.testing.assert_array_equal(panel.draw(away), panel.draw(first_frame(trajectories)))


def test_in_3d_the_nearer_particle_hides_the_farther(still):
    trajectories = still([[0.5, 0.5, 0.5]] * 2, ["water", "sand"])
    toward = fit_camera(trajectories).axes[2]
    middle = np.full(3, 0.5)
    panel = PanelRenderer(trajectories, 200)
    for sign, nearer in ((1, 0), (-1, 1)):
        image = panel.draw(np.stack([middle + sign * 0.2 * toward, middle - sign * 0.2 * toward]))
        shown = image[panel.pixel_of(middle)].astype(int)
        blue_over_red = shown[2] > shown[0]
        assert blue_over_red == (nearer == 0)


@pytest.mark.parametrize(("gravity", "up"), [(None, 1), ((0.0, 0.0, -9.81), 2), ((0.0, -9.81, 0.0), 1)])
def test_in_3d_gravity_points_down(still, gravity, up):
    trajectories = still([[0.5, 0.5, 0.5]], ["water"], gravity=gravity)
    axes = fit_camera(trajectories).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[0, up] == pytest.approx(0)
    assert axes[1, up] > 0.9
    panel = PanelRenderer(trajectories, 200)
    assert panel.pixel_of(np.full(3, 0.5) + 0.2 * np.eye(3)[up])[0] < panel.pixel_of(np.full(3, 0.5))[0]


def test_in_3d_the_whole_box_is_in_view(still):
    trajectories = still([[0.5, 0.5, 0.5]], ["water"])
    corners = np.stack(np.meshgrid([0.1, 0.9], [0.1, 0.9], [0.1, 0.9]), axis=-1).reshape(-1, 3)
    assert PanelRenderer(trajectories, 200).count_outside(corners) == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_spacing_of_a_lattice_is_the_lattice_constant(dim):
    axis = 0.01 * np.arange(12)
    lattice = np.stack(np.meshgrid(*[axis] * dim), axis=-1).reshape(-1, dim)
    assert particle_spacing(lattice) == pytest.approx(0.01, rel=0.05 if dim == 2 else 0.12)


@pytest.mark.parametrize("dim", [2, 3])
def test_spacing_of_random_particles_is_the_mean_spacing(dim):
    points = np.random.default_rng(0).uniform(size=(4000, dim))
    assert particle_spacing(points) == pytest.approx(4000 ** (-1 / dim), rel=0.1)


def test_a_single_particle_is_drawn(still):
    assert particle_spacing(np.zeros((1, 2))) == np.inf
    trajectories = still([[0.5, 0.5]], ["water"])
    image = PanelRenderer(trajectories, 100).draw(first_frame(trajectories))
    assert (image == material_colour("water")).all(axis=2).sum() > 100


@pytest.mark.parametrize(("gravity", "toward"), [((9.81, 0.0), (1, 0)), ((-1e-4, 0.0), (-1, 0)), ((0.0, 1.0), (0, 1))])
def test_an_arrow_points_where_gravity_does_unless_that_is_down(still, gravity, toward):
    plain = still([[0.2, 0.2]], ["water"])
    turned = dataclasses.replace(plain, gravity=gravity)
    drawn = PanelRenderer(turned, 300).draw(first_frame(plain)).astype(int)
    rows, columns = np.nonzero((drawn != PanelRenderer(plain, 300).draw(first_frame(plain))).any(axis=2))
    assert rows.max() < 60  # the disc lies in the upper right corner
    assert columns.min() > 240
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    dark = np.argwhere(drawn.sum(axis=2) < 300)[:, ::-1] - middle  # right and down
    along, across = np.array([toward[0], -toward[1]]), np.array([toward[1], toward[0]])
    head = dark[np.abs(dark @ across) > 3].mean(axis=0)  # the widest part
    assert head @ along > 1.5
    assert abs(head @ across) < 2


@pytest.mark.parametrize("gravity", [(0.0, -9.81), (0.0, 0.0)])
def test_gravity_that_is_down_or_zero_draws_no_arrow(still, gravity):
    plain = still([[0.2, 0.2]], ["water"])
    drawn = PanelRenderer(dataclasses.replace(plain, gravity=gravity), 300).draw(first_frame(plain))
    np.testing.assert_array_equal(drawn, PanelRenderer(plain, 300).draw(first_frame(plain)))
