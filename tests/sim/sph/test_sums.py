"""The kernel, and pairs of neighbours."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import quad

from nmpm.sim.sph.wcsph import NORM, SUPPORT, PairLists, expansion, pair_geometry, push, slope, weight

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


def near(position, walls, reach):
    """The lists, the sorted positions, and the two sets of pairs."""
    lists = PairLists(walls, reach)
    order, starts = lists.sort_by_cell(*np.ascontiguousarray(position.T))
    assert sorted(order) == list(range(len(position)))
    x, y = np.ascontiguousarray(position[order].T)
    return lists, x, y, *lists.near(x, y, starts)


def as_set(pairs):
    return {tuple(map(int, pair)) for pair in zip(*pairs[:2], strict=True)}


@settings(max_examples=60, deadline=None)
@given(points(), points(), st.floats(0.05, 0.5))
def test_pairs_are_those_of_brute_force_each_once(position, others, reach):
    corners = np.array([[LOW[0], LOW[1]], [HIGH[0], HIGH[1]]])
    lists, x, y, pairs, wall_pairs = near(position, np.concatenate([others, corners]), reach)
    close = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < reach * reach
    assert as_set(pairs) == as_set(np.nonzero(np.triu(close, 1)))
    assert len(pairs.first) == len(as_set(pairs))
    close = (x[:, None] - lists.wall_x) ** 2 + (y[:, None] - lists.wall_y) ** 2 < reach * reach
    assert as_set(wall_pairs) == as_set(np.nonzero(close))


@pytest.mark.parametrize("seed", [0, 1])
def test_pair_forces_conserve_momenta_and_viscosity_takes_energy_unless_the_motion_is_rigid(seed):
    rng, h = np.random.default_rng(seed), 0.1
    _, x, y, pairs, _ = near(rng.uniform(LOW, HIGH, (80, 2)), np.array([LOW, HIGH]), SUPPORT * h)
    table = np.stack([x, y, *rng.normal(size=(2, 80)), rng.uniform(900, 1100, 80), x, y])

    def accelerations(pressure, viscosity):
        table[5:] = 0.0
        pair_geometry(table, pairs, h)
        expansion(pairs, table, 1.0, 0.0, np.zeros(2), 0.01 * h * h, np.zeros(80))
        push(pairs, table, pressure, 1.0, viscosity)
        return table[5:].copy()

    drag = accelerations(np.zeros(80), 1.0)
    for ax, ay in (drag, accelerations(rng.normal(size=80), 0.0)):
        assert np.abs(ax).max() > 1e-6
        np.testing.assert_allclose([ax.sum(), ay.sum(), (x * ay - y * ax).sum()], 0.0, atol=1e-12 * np.abs(ax).sum())
    assert (table[2:4] * drag).sum() < 0
    table[2], table[3] = 1.0 - 3.0 * y, 2.0 + 3.0 * x
    np.testing.assert_allclose(accelerations(np.zeros(80), 1.0), 0.0, atol=1e-12 * np.abs(drag).max())
