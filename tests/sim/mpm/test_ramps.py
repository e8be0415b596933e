import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from nmpm.errors import ConfigError
from nmpm.sim.mpm.ramps import Ramp, RampRanges, distance_to_ramps

RAMPS = RampRanges(number=(2, 4), length=(0.1, 0.3), thickness=0.03, angle=(10.0, 50.0), gap=0.05)
BOX = ((0.1, 0.9), (0.1, 0.9))

ramps = st.builds(
    Ramp,
    centre=st.tuples(st.floats(0.2, 0.8), st.floats(0.2, 0.8)),
    length=st.floats(0.05, 0.4),
    thickness=st.floats(0.01, 0.05),
    angle=st.floats(-math.pi, math.pi),
)


@given(ramp=ramps, seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_distances_are_those_to_the_densely_sampled_outline(ramp, seed):
    points = np.random.default_rng(seed).uniform(0, 1, (200, 2))
    corners = ramp.outline()[::24]
    sides = [np.linspace(a, b, 2000) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    nearest = cKDTree(np.concatenate(sides)).query(points)[0]
    found = ramp.distance(points)
    np.testing.assert_allclose(np.abs(found), nearest, atol=2e-4)
    along, across = (
        np.array([math.cos(ramp.angle), math.sin(ramp.angle)]),
        np.array([-math.sin(ramp.angle), math.cos(ramp.angle)]),
    )
    local = points - np.array(ramp.centre)
    inside = (np.abs(local @ along) < ramp.length / 2) & (np.abs(local @ across) < ramp.thickness / 2)
    np.testing.assert_array_equal(found < 0, inside)


@given(ramp=ramps, shift=st.tuples(st.floats(-2, 2), st.floats(-2, 2)))
@settings(max_examples=40, deadline=None)
def test_a_moved_bar_is_as_far_from_moved_points(ramp, shift):
    points = np.random.default_rng(0).uniform(0, 1, (50, 2))
    np.testing.assert_allclose(ramp.moved(np.array(shift)).distance(points + shift), ramp.distance(points), atol=1e-12)


@given(ramp=ramps, spacing=st.floats(0.004, 0.02))
@settings(max_examples=40, deadline=None)
def test_particles_fill_the_bar_evenly(ramp, spacing):
    particles = ramp.particles(spacing)
    assert np.all(ramp.distance(particles) < 0)
    numbers = max(1, round(ramp.length / spacing)) * max(1, round(ramp.thickness / spacing))
    assert len(particles) == numbers
    np.testing.assert_allclose(particles.mean(axis=0), ramp.centre, atol=1e-12)


@given(seed=st.integers(0, 2**32), low=st.tuples(st.floats(0.15, 0.5), st.floats(0.4, 0.6)))
@settings(max_examples=40, deadline=None)
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


def test_distance_is_to_the_nearest_bar():
    one, two = Ramp((0.3, 0.3), 0.2, 0.02, 0.0), Ramp((0.7, 0.7), 0.2, 0.02, 0.0)
    points = np.array([[0.3, 0.36], [0.7, 0.76], [0.7, 0.7]])
    np.testing.assert_allclose(distance_to_ramps((one, two), points), [0.05, 0.05, -0.01], atol=1e-12)
    assert np.all(np.isinf(distance_to_ramps((), points)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"number": (3, 2)}, "ramps.number"),
        ({"length": (0.0, 0.1)}, "ramps.length"),
        ({"thickness": 0.2}, "ramps.thickness"),
        ({"angle": (0.0, 120.0)}, "ramps.angle"),
        ({"gap": -0.1}, "ramps.gap"),
    ],
)
def test_invalid_values_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(RAMPS, **changes)


def test_too_many_for_the_box_is_an_error():
    crowded = dataclasses.replace(RAMPS, number=(60, 60))
    with pytest.raises(ConfigError, match="No room for 60 ramps"):
        crowded.draw(BOX, [], np.random.default_rng(0))
