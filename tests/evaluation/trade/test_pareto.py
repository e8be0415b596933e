"""Pareto sets and their probabilities under resampling, in closed form."""

import numpy as np
import pytest

from nmpm.evaluation.bootstrap import intervals, resampled_means
from nmpm.evaluation.trade.pareto import pareto_members, pareto_probabilities


def test_members_are_dominated_by_nobody():
    times = np.array([1.0, 2.0, 3.0, 2.5, 1.0])
    errors = np.array([5.0, 3.0, 1.0, 4.0, 6.0])  # the fourth is behind the second, the fifth behind the first
    np.testing.assert_array_equal(pareto_members(times, errors), [True, True, True, False, False])


def test_equal_points_are_both_members_and_equal_times_compete_by_error():
    np.testing.assert_array_equal(pareto_members(np.ones(2), np.ones(2)), [True, True])
    np.testing.assert_array_equal(pareto_members(np.ones(2), np.array([1.0, 2.0])), [True, False])
    np.testing.assert_array_equal(pareto_members(np.array([1.0, 2.0]), np.ones(2)), [True, False])


def test_probability_of_the_slower_point_is_that_of_drawing_its_good_scene():
    """Two scenes: the slower point is better in one by 1 and worse in the other by 2. Its mean is lower only if both
    draws are the good scene, with probability 1/4; the faster point is always a member."""
    times, errors = np.array([1.0, 2.0]), np.array([[2.0, 2.0], [1.0, 4.0]])
    sure, chance = pareto_probabilities(times, errors)
    assert sure == 1
    assert chance == pytest.approx(0.25, abs=0.03)


def test_resampling_is_the_same_for_the_same_seed_and_pairs_the_points():
    errors = np.random.default_rng(0).random((3, 8))
    np.testing.assert_array_equal(resampled_means(errors, 1), resampled_means(errors, 1))
    assert (resampled_means(errors, 1) != resampled_means(errors, 2)).any()
    twice = resampled_means(np.stack([errors[0], 2 * errors[0]]))
    np.testing.assert_allclose(twice[:, 1], 2 * twice[:, 0])


def test_intervals_contain_the_mean_and_vanish_for_equal_scenes():
    errors = np.stack([np.full(6, 3.0), np.arange(6.0)])
    bounds = intervals(errors)
    np.testing.assert_allclose(bounds[0], 3.0)
    assert bounds[1, 0] < 2.5 < bounds[1, 1]


def test_no_points_no_probabilities():
    assert len(pareto_probabilities(np.zeros(0), np.zeros((0, 4)))) == 0
