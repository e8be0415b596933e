from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from nmpm.sim.sph.neighbours import CellGrid, PairFinder

LOW, HIGH = np.array([-0.3, 0.1]), np.array([0.9, 0.8])


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


@settings(max_examples=150, deadline=None)
@given(points(), st.floats(0.05, 0.5))
def test_pairs_within_are_those_of_brute_force_each_once(position, reach):
    grid = CellGrid.covering(LOW, HIGH, reach)
    _, starts, x, y = sorted_points(grid, position)
    first, second = PairFinder(grid).pairs_within(x, y, starts)
    near = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < reach * reach
    assert as_set((first, second)) == as_set(np.nonzero(np.triu(near, 1)))
    assert len(first) == len(as_set((first, second)))


@settings(max_examples=150, deadline=None)
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


def test_sorting_is_a_stable_order_of_all_particles():
    grid = CellGrid.covering(LOW, HIGH, 0.1)
    position = np.random.default_rng(1).uniform(LOW, HIGH, (500, 2))
    order, starts, _, _ = sorted_points(grid, position)
    assert sorted(order) == list(range(500))
    assert starts[0] == 0
    assert starts[-1] == 500
    assert all(np.all(np.diff(order[a:b]) > 0) for a, b in pairwise(starts))
