import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nmpm.errors import ConfigError
from nmpm.obstacles import Box, Disc, Polygon, Ramp, Sphere
from nmpm.sim.mpm.layouts import SimulatedRamp

SQUARE = [(0.2, 0.3), (0.6, 0.3), (0.6, 0.5), (0.2, 0.5)]


finite = st.floats(-1, 2)
places = st.lists(st.tuples(finite, finite), min_size=1, max_size=20)
angles, lengths, thin = st.floats(-3, 3), st.floats(0.05, 0.4), st.floats(0.01, 0.05)


@settings(deadline=None, max_examples=40)
@given(places, angles, lengths, thin, st.floats(0.004, 0.02))
def test_ramps_are_those_of_the_simulator(points, angle, length, thickness, spacing):
    ramp, simulated = (kind((0.5, 0.4), length, thickness, angle) for kind in (Ramp, SimulatedRamp))
    ours = ramp.distance(torch.tensor(points, dtype=torch.float64))
    np.testing.assert_allclose(ours.numpy(), simulated.distance(np.array(points)), atol=1e-12)
    np.testing.assert_allclose(ramp.particles(spacing).numpy(), simulated.particles(spacing), atol=1e-12)


@pytest.mark.parametrize("body", [Disc((0.5, 0.4), 0.1), Sphere((0.5, 0.4, 0.6), 0.1)])
def test_round_bodies_have_one_particle_per_volume_and_none_outside(body):
    particles, centre = body.particles(0.01), torch.tensor(body.centre, dtype=torch.float64)
    distance = (particles - centre).norm(dim=-1)
    assert len(particles) == round(math.pi * 100 if body.dim == 2 else 4 / 3 * math.pi * 1000)
    torch.testing.assert_close(body.distance(particles), distance - 0.1)
    assert distance.max() < 0.1
    assert (distance < 0.05).sum() == pytest.approx(len(particles) / 2**body.dim, abs=1, rel=0.01)
    torch.testing.assert_close(particles.mean(0), centre, atol=1e-3, rtol=0)


@settings(deadline=None)
@given(st.integers(3, 8), st.floats(0, 6))
@example(4, 2.220446049250313e-16)  # half of its lattice's outer points lie on its edges
def test_polygons_are_filled_evenly_either_way_round(corners, turn):
    angles = turn + 2 * math.pi * torch.arange(corners, dtype=torch.float64) / corners
    outline = 0.5 + 0.2 * torch.stack([torch.cos(angles), torch.sin(angles)], dim=-1)
    area = corners / 2 * 0.2**2 * math.sin(2 * math.pi / corners)
    there, back = Polygon(outline).particles(0.01), Polygon(outline.flip(0)).particles(0.01)
    assert len(there) == pytest.approx(area / 0.01**2, rel=0.12)
    assert len(there) == len(back)
    torch.testing.assert_close(there.mean(0), back.mean(0))


@settings(deadline=None, max_examples=40)
@given(places, angles, st.booleans())
def test_distances_from_a_turned_rectangle_are_the_same_as_from_it_as_polygon(points, angle, backwards):
    where, ramp = torch.tensor(points, dtype=torch.float64), Ramp((0.5, 0.4), 0.3, 0.1, angle)
    local = torch.tensor([[0.15, 0.05], [-0.15, 0.05], [-0.15, -0.05], [0.15, -0.05]], dtype=torch.float64)
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    corners = torch.tensor([0.5, 0.4], dtype=torch.float64) + local @ turn
    polygon = Polygon(corners.flip(0) if backwards else corners)
    torch.testing.assert_close(polygon.distance(where), ramp.distance(where), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.5, 0.1), -0.1),  # inside
        ((0.5, -0.3), 0.3),  # below a side
        ((1.0, 1.0), math.sqrt(0.5)),  # beyond the long side
        ((1.3, -0.4), 0.5),  # beyond a corner
        ((-0.3, -0.4), 0.5),
        ((0.5, 0.0), 0.0),
        ((0.0, 0.0), 0.0),
    ],
)
def test_distances_from_a_triangle(point, distance):
    """One corner at the origin, one at (1, 0), with the long side from there to (0, 1)."""
    triangle = Polygon([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    assert float(triangle.distance(torch.tensor(point, dtype=torch.float64))) == pytest.approx(distance, abs=1e-12)


@pytest.mark.parametrize(
    ("make", "parameters"),
    [
        (lambda *given: Ramp(given[:2], *given[2:]), (0.5, 0.4, 0.3, 0.05, 0.4)),
        (lambda *given: Ramp.from_end(given[:2], *given[2:]), (0.5, 0.4, 0.3, 0.05, 0.4)),
        (lambda *given: Disc(given[:2], given[2]), (0.5, 0.4, 0.1)),
        (lambda *given: Polygon([given[:2], given[2:4], given[4:]]), (0.2, 0.3, 0.7, 0.25, 0.5, 0.6)),
        (lambda *given: Box(given[:3], given[3:6], given[6:]), (0.5, 0.4, 0.6, 0.3, 0.2, 0.1, 0.4, -0.3, 0.0)),
        (lambda *given: Sphere(given[:3], given[3]), (0.5, 0.4, 0.6, 0.21)),
    ],
)
def test_gradients_are_those_of_finite_differences(make, parameters):
    points = torch.rand(50, make(*parameters).dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    values = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in parameters]
    assert torch.autograd.gradcheck(lambda *given: make(*given).distance(points), values)
    if not isinstance(make(*parameters), Polygon):  # whose lattice does not move with its corners
        assert torch.autograd.gradcheck(lambda *given: make(*given).particles(0.067), values)


def test_particles_of_a_polygon_follow_every_affine_motion_of_its_corners():
    corners = torch.tensor(SQUARE, dtype=torch.float64)
    motion = torch.tensor([[0.3, -1.0], [0.4, 2.0]], dtype=torch.float64)
    particles, moved = torch.autograd.functional.jvp(
        lambda given: Polygon(given).particles(0.02), corners, corners @ motion + 1.0
    )
    torch.testing.assert_close(moved, particles @ motion + 1.0)


def test_gradients_on_outlines_and_at_centres_are_finite_and_those_of_one_side():
    """A norm has no derivative at 0, where points on an outline would have one."""
    side = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    on_top = torch.tensor([[0.5, 0.5], [0.5, 0.4]], dtype=torch.float64)
    for make in (lambda given: Ramp((0.5, 0.4), 0.6, given, 0.0), lambda given: Disc((0.5, 0.4), given / 2)):
        slopes = torch.autograd.functional.jacobian(lambda given, make=make: make(given).distance(on_top), side)
        assert slopes.tolist() == pytest.approx([-0.5, -0.5])


def test_boxes_are_filled_with_a_lattice_that_turns_with_them():
    turn = (0.0, 0.0, math.pi / 2)
    flat, turned = (Box((0.5, 0.4, 0.6), (0.2, 0.1, 0.06), each).particles(0.02) for each in ((0.0, 0.0, 0.0), turn))
    assert len(flat) == 10 * 5 * 3
    assert (flat.amax(0) - flat.amin(0)).tolist() == pytest.approx([0.18, 0.08, 0.04])
    assert (turned.amax(0) - turned.amin(0)).tolist() == pytest.approx([0.08, 0.18, 0.04])


def test_distances_from_a_box_turned_about_one_axis_are_those_from_the_ramp_of_its_section():
    points = torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    tall = Box((0.5, 0.4, 0.5), (0.3, 0.1, 20.0), (0.0, 0.0, 0.7))
    torch.testing.assert_close(tall.distance(points), Ramp((0.5, 0.4), 0.3, 0.1, 0.7).distance(points[:, :2]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere((0.5, 0.5), 0.1).distance(torch.zeros(1, 3)), "centre = .*three numbers"),
        (lambda: Sphere((0.5, 0.5, 0.5), 0.0).distance(torch.zeros(1, 3)), "radius = 0"),
        (lambda: Box((0.5, 0.5, 0.5), (0.1, -0.1, 0.1)).distance(torch.zeros(1, 3)), "side = -0.1"),
        (lambda: Box((0.5, 0.5, 0.5), (0.1, 0.1, 0.1), (math.nan, 0.0, 0.0)).particles(0.1), "rotation = .*finite"),
        (lambda: Disc((0.5, 0.5), 0.0).particles(0.01), "radius = 0"),
        (lambda: Ramp((0.5, 0.5), float("nan"), 0.1, 0.0).particles(0.01), "side = nan"),
        (lambda: Disc((0.5, 0.5), 0.1).particles(0.0), "spacing = 0"),
        (lambda: Disc((0.5, 0.5), -0.1).distance(torch.zeros(1, 2)), "radius = -0.1"),
        (lambda: Ramp((0.5, 0.5), 0.1, 0.0, 0.0).distance(torch.zeros(1, 2)), "thickness = 0"),
        (lambda: Ramp((0.5, float("inf")), 0.1, 0.1, 0.0).distance(torch.zeros(1, 2)), "centre = .*finite"),
        (lambda: Polygon([(0.0, 0.0), (1.0, 0.0), (0.0, float("nan"))]), "corners = .*finite"),
        (lambda: Polygon(SQUARE[:2]), "three or more corners"),
        (lambda: Polygon([SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]), "convex"),
    ],
)
def test_impossible_bodies_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
