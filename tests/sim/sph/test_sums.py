"""The kernel, and pairs of neighbours."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import quad
from scipy.spatial import cKDTree

from nmpm.sim.sph.neighbours import CellGrid, PairFinder
from nmpm.sim.sph.sums import NORM, SUPPORT, slope, weight

LOW, HIGH = np.array([-0.3, 0.1]), np.array([0.9, 0.8])


def test_the_kernel_integrates_to_one_and_has_known_values():
    integral = sum(quad(lambda q: 2 * math.pi * q * NORM * weight(q), n, n + 1)[0] for n in range(3))
    assert integral == pytest.approx(1.0, abs=1e-12)
    assert [weight(q) for q in (0.0, 1.0, 2.0, SUPPORT, 1e6)] == [3**5 - 6 * 2**5 + 15, 2**5 - 6, 1.0, 0.0, 0.0]
    assert [slope(q) for q in (0.0, SUPPORT, 1e6)] == [0.0, 0.0, 0.0]
    for q in np.linspace(1e-3, 4, 50):
        assert slope(q) == pytest.approx((weight(q + 1e-5) - weight(q - 1e-5)) / 2e-5, abs=1e-6)


def points(most=40):
    inside = st.floats(0.0, 1.0, width=32)
    return (
        st.integers(1, most)
        .flatmap(lambda n: arrays(np.float64, (n, 2), elements=inside))
        .map(lambda unit: LOW + unit * (HIGH - LOW))
    )


def sorted_points(grid, position):
    order, starts = grid.sort_by_cell(*np.ascontiguousarray(position.T))
    x, y = np.ascontiguousarray(position[order].T)
    return order, starts, x, y


def as_set(pairs):
    return {tuple(map(int, pair)) for pair in zip(*pairs, strict=True)}


@settings(max_examples=50, deadline=None)
@given(points(), st.floats(0.05, 0.5))
def test_pairs_within_are_those_of_brute_force_each_once(position, reach):
    grid = CellGrid.covering(LOW, HIGH, reach)
    _, starts, x, y = sorted_points(grid, position)
    first, second = PairFinder(grid).pairs_within(x, y, starts)
    near = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < reach * reach
    assert as_set((first, second)) == as_set(np.nonzero(np.triu(near, 1)))
    assert len(first) == len(as_set((first, second)))


@settings(max_examples=50, deadline=None)
@given(points(), points(), st.floats(0.05, 0.5))
def test_pairs_between_are_those_of_brute_force(position, others, reach):
    grid = CellGrid.covering(LOW, HIGH, reach)
    _, starts, other_x, other_y = sorted_points(grid, others)
    x, y = np.ascontiguousarray(position.T)
    pairs = PairFinder(grid).pairs_between(x, y, other_x, other_y, starts)
    near = (x[:, None] - other_x) ** 2 + (y[:, None] - other_y) ** 2 < reach * reach
    assert as_set(pairs) == as_set(np.nonzero(near))


def test_memory_grows_with_the_pairs():
    grid = CellGrid.covering(LOW, HIGH, 0.1)
    finder = PairFinder(grid)
    rng = np.random.default_rng(0)
    for count in (10, 2000, 100):
        position = rng.uniform(LOW, HIGH, (count, 2))
        _, starts, x, y = sorted_points(grid, position)
        assert as_set(finder.pairs_within(x, y, starts)) == as_set(
            cKDTree(np.stack([x, y], -1)).query_pairs(0.1, output_type="ndarray").T
        )
