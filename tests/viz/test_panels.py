import dataclasses

import numpy as np
import pytest

from nmpm.colours import INTERIOR, OBSTACLE, WALL, material_colours
from nmpm.viz.animation import format_distance
from nmpm.viz.camera import fit_camera
from nmpm.viz.panel import PanelRenderer, format_time, particle_spacing


def colour(name):
    return material_colours([name])[name]


def draw(trajectories, position=None, side=200):
    return PanelRenderer(trajectories, side).draw(
        next(iter(trajectories.positions.values()))[0] if position is None else position
    )


def pixel(trajectories, image, point):
    """The colour of the pixel where a point (D,) is drawn."""
    camera = fit_camera(trajectories)
    right, up, _ = camera.project(np.array(point)) * image.shape[1] / camera.width
    return tuple(image[int(image.shape[0] - up), int(right)])


def test_particles_and_walls_are_drawn_at_their_places_in_their_colours(falling):
    image = draw(falling)
    assert image.shape == (200, 200, 3)
    assert pixel(falling, image, [0.3, 0.8]) == colour("water")
    assert np.abs(np.array(pixel(falling, image, [0.7, 0.8]), int) - colour("sand")).max() < 45
    assert pixel(falling, image, [0.5, 0.5]) == INTERIOR
    assert pixel(falling, image, [0.09, 0.5]) == WALL
    rows, columns = np.nonzero((image == colour("water")).all(axis=2))
    margin = 0.008 * 0.84
    assert columns.mean() == pytest.approx((0.3 - 0.08 + margin) / (0.84 + 2 * margin) * 200, abs=1)
    assert rows.mean() == pytest.approx((0.92 + margin - 0.8) / (0.84 + 2 * margin) * 200, abs=1)
    moved = falling.positions["simulation"][0] + 0.4 * 0.84 / 200  # less than a pixel
    assert (draw(falling, moved) != image).any()


def test_obstacles_and_wide_boxes_are_drawn(still):
    trajectories = still([[0.5, 0.5]], ["water"], obstacle=np.array([[0.2, 0.3]]))
    assert pixel(trajectories, draw(trajectories), [0.2, 0.3]) == OBSTACLE
    assert len(draw(still([[1, 1]], ["water"], bounds=((0, 4), (0, 2))), side=400)) == pytest.approx(200, abs=4)
    assert draw(still([[9, 0.5], [500, 0.5]], ["water"] * 2, bounds=((0, 1000), (0, 1))), side=400).shape[1] == 400


def test_particles_out_of_view_are_counted_and_not_drawn(falling):
    positions = np.array([[0.3, 0.8], [1e30, -1e30]])
    assert PanelRenderer(falling, 200).count_outside(positions) == 1
    assert pixel(falling, draw(falling, positions), positions[0]) == colour("water")


def test_particles_wrap_along_a_periodic_axis(falling):
    trajectories = dataclasses.replace(falling, periodic=(True, False), domain=None)
    away = trajectories.positions["simulation"][0] + np.array([1.6, 0])
    assert PanelRenderer(trajectories, 200).count_outside(away) == 0
    np.testing.assert_array_equal(draw(trajectories, away), draw(trajectories))


def test_in_3d_the_nearer_particle_hides_the_farther(still):
    trajectories = still([[0.5, 0.5, 0.5]] * 2, ["water", "sand"])
    toward, middle = fit_camera(trajectories).axes[2], np.full(3, 0.5)
    for sign, water_is_nearer in ((1, True), (-1, False)):
        image = draw(trajectories, np.stack([middle + sign * 0.2 * toward, middle - sign * 0.2 * toward]))
        red, _, blue = pixel(trajectories, image, middle)
        assert (blue > red) == water_is_nearer


@pytest.mark.parametrize(("gravity", "up"), [(None, 1), ((0.0, 0.0, -9.81), 2), ((0.0, -9.81, 0.0), 1)])
def test_in_3d_gravity_points_down_and_the_whole_box_is_in_view(still, gravity, up):
    trajectories = still([[0.5, 0.5, 0.5]], ["water"], gravity=gravity)
    axes = fit_camera(trajectories).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[0, up] == pytest.approx(0)
    assert axes[1, up] > 0.9
    corners = np.stack(np.meshgrid([0.1, 0.9], [0.1, 0.9], [0.1, 0.9]), axis=-1).reshape(-1, 3)
    assert PanelRenderer(trajectories, 200).count_outside(corners) == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_spacing_is_the_lattice_constant_or_the_mean_spacing(dim):
    lattice = np.stack(np.meshgrid(*[0.01 * np.arange(12)] * dim), axis=-1).reshape(-1, dim)
    assert particle_spacing(lattice) == pytest.approx(0.01, rel=0.05 if dim == 2 else 0.12)
    points = np.random.default_rng(0).uniform(size=(4000, dim))
    assert particle_spacing(points) == pytest.approx(4000 ** (-1 / dim), rel=0.1)


@pytest.mark.parametrize(("gravity", "toward"), [((9.81, 0.0), (1, 0)), ((-1e-4, 0.0), (-1, 0)), ((0.0, 1.0), (0, 1))])
def test_an_arrow_points_where_gravity_does_unless_that_is_down(still, gravity, toward):
    plain = still([[0.2, 0.2]], ["water"])
    drawn = draw(dataclasses.replace(plain, gravity=gravity), side=300).astype(int)
    rows, columns = np.nonzero((drawn != draw(plain, side=300)).any(axis=2))
    assert rows.max() < 60  # the disc lies in the upper right corner
    assert columns.min() > 240
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    dark = np.argwhere(drawn.sum(axis=2) < 300)[:, ::-1] - middle  # right and down
    along, across = np.array([toward[0], -toward[1]]), np.array([toward[1], toward[0]])
    head = dark[np.abs(dark @ across) > 3].mean(axis=0)  # the widest part
    assert head @ along > 1.5
    assert abs(head @ across) < 2
    down = dataclasses.replace(plain, gravity=(0.0, -9.81))
    np.testing.assert_array_equal(draw(down, side=300), draw(plain, side=300))


def test_times_and_distances_have_the_same_number_of_decimals(falling):
    assert [format_time(falling, frame) for frame in (0, 4, 10)] == ["0.0000 s", "0.0100 s", "0.0250 s"]
    assert format_time(dataclasses.replace(falling, dt=1.2), 10) == "12.0 s"
    assert [format_distance(falling, length) for length in (0.0, 1.5, 1e20)] == ["0.0000", "1.5000", "1.0e+20"]
