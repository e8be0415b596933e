"""Pareto sets in closed form, and recommendations from points with known times and errors."""

import numpy as np
import pytest

from nmpm.evaluation.bootstrap import intervals, resampled_means
from nmpm.evaluation.trade import Kind
from nmpm.evaluation.trade.ranking import (
    Setting,
    at_equal_error,
    beside_simulator,
    pareto_members,
    pareto_probabilities,
    rank,
    recommend,
)
from tests.evaluation.trade.made_up import point

POINTS = [
    point("simulator, 12 substeps", Kind.SIMULATOR, 4.0, (0.0, 0.0)),
    point("simulator, 6 substeps", Kind.SIMULATOR, 2.0, (0.4, 0.6)),
    point("simulator, 3 substeps", Kind.SIMULATOR, 0.5, (9.0, 9.0), failures={1: "gains 30% of energy"}),
    point("ours", time=1.0, errors=(0.8, 1.2)),
    point("ours, slower", time=3.0, errors=(0.9, 1.1)),
    point("ours, batch 8", time=0.1, errors=(0.8, 1.2), batch=8),
    point("theirs", Kind.OTHER, 0.9, (2.0, 3.0)),
    point("nothing moves", Kind.TRIVIAL, 0.001, (50.0, 50.0)),
    point("nudged", Kind.FLOOR, 4.0, (0.01, 0.01)),
]


def test_members_are_dominated_by_nobody_and_equal_points_are_both_members():
    times = np.array([1.0, 2.0, 3.0, 2.5, 1.0])
    errors = np.array([5.0, 3.0, 1.0, 4.0, 6.0])  # the fourth is behind the second, the fifth behind the first
    np.testing.assert_array_equal(pareto_members(times, errors), [True, True, True, False, False])
    np.testing.assert_array_equal(pareto_members(np.ones(2), np.ones(2)), [True, True])
    np.testing.assert_array_equal(pareto_members(np.array([1.0, 2.0]), np.ones(2)), [True, False])


def test_probability_of_the_slower_point_is_that_of_drawing_its_good_scene():
    """Two scenes: the slower point is better in one by 1 and worse in the other by 2. Its mean is lower only if both
    draws are the good scene, with probability 1/4; the faster point is always a member."""
    times, errors = np.array([1.0, 2.0]), np.array([[2.0, 2.0], [1.0, 4.0]])
    sure, chance = pareto_probabilities(times, errors)
    assert sure == 1
    assert chance == pytest.approx(0.25, abs=0.03)
    assert len(pareto_probabilities(np.zeros(0), np.zeros((0, 4)))) == 0


def test_resampling_pairs_the_points_and_intervals_contain_the_mean():
    errors = np.random.default_rng(0).random((3, 8))
    np.testing.assert_array_equal(resampled_means(errors), resampled_means(errors))
    twice = resampled_means(np.stack([errors[0], 2 * errors[0]]))
    np.testing.assert_allclose(twice[:, 1], 2 * twice[:, 0])
    bounds = intervals(np.stack([np.full(6, 3.0), np.arange(6.0)]))
    np.testing.assert_allclose(bounds[0], 3.0)
    assert bounds[1, 0] < 2.5 < bounds[1, 1]


def test_recommendations_step_from_the_least_budget_to_the_simulator_itself():
    steps = recommend(POINTS)
    names = ["nothing moves", "theirs", "ours", "simulator, 6 substeps", "simulator, 12 substeps"]
    assert [step.name for step in steps] == names
    assert [step.milliseconds for step in steps] == pytest.approx([0.001, 0.9, 1, 2, 4])
    assert "the best emulator there, ours, has 1000 (800 to 1200) ×10⁻³." in steps[3].sentence
    assert "it made these data" in steps[4].sentence


def test_unstable_points_floors_and_batches_do_not_take_part_in_latency():
    ranks = rank(POINTS, "mse")
    assert not ranks["simulator, 3 substeps"].member
    assert ranks["nudged"].probability == 0
    assert ranks["ours"].member  # a batch is no answer to one scene
    assert ranks["ours, batch 8"].member
    assert not ranks["ours, slower"].member


def test_the_simulator_at_equal_time_and_at_equal_error():
    sentence = beside_simulator(POINTS)
    assert "ours, beside the simulator: no stable simulator setting is as fast" in sentence
    assert "simulator, 6 substeps is no less accurate and takes 2 × its time" in sentence
    assert "(the shipped setting, simulator, 12 substeps, 4 ×)" in sentence
    slower = beside_simulator([one for one in POINTS if one.name != "ours"])
    assert "simulator, 6 substeps is no slower and has 0.5 × its error" in slower
    assert beside_simulator([one for one in POINTS if one.kind is not Kind.SIMULATOR]) == ""
    assert beside_simulator([]) == ""


def test_the_setting_at_equal_error_is_the_cheapest_that_is_no_less_accurate():
    shipped, half, coarse = Setting("shipped", 4.0, 0.0), Setting("half", 2.0, 1.0), Setting("coarse", 0.5, 3.0)
    for error, expected in ((0.0, shipped), (0.9, shipped), (1.0, half), (2.9, half), (3.0, coarse)):
        assert at_equal_error([half, shipped, coarse], error) == expected
    assert at_equal_error([half], 0.5) is None


def test_the_fastest_of_equally_accurate_emulators_stands_beside_the_simulator():
    """A form that is more accurate by chance, and slower, let the simulator win."""
    chance = point("ours, emulated", time=3.6, errors=(0.79, 1.19))
    sentence = beside_simulator([*POINTS, chance])
    assert "The fastest of the emulators that are as accurate as any, ours, beside the simulator" in sentence
    assert "no stable simulator setting is as fast" in sentence
