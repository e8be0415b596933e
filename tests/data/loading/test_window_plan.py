"""Which windows make up which batch, for any number of ranks, of batches and of windows in a batch."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nmpm.data.batches import OPENING, WindowPlan
from nmpm.errors import ConfigError

PLANS = st.builds(
    WindowPlan,
    frames=st.lists(st.integers(6, 30), min_size=1, max_size=12).map(tuple),
    length=st.integers(2, 6),
    batch_size=st.integers(1, 9),
    buffer_size=st.integers(1, 5),
    passes=st.sampled_from([0.3, 1, 4]),
    seed=st.integers(0, 2**40),
)
SORTED = WindowPlan(frames=(12,) * 6, length=6, batch_size=2, buffer_size=4, passes=2.0, seed=1, bucket=4)


@given(plan=PLANS, index=st.integers(0, 500), world=st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_windows_lie_inside_trajectories_of_the_buffer_and_buffers_cover_all(plan, index, world):
    members = plan.members(index // plan.batches_per_buffer(world))
    assert len(set(members)) == len(members) <= min(plan.buffer_size, len(plan.frames))
    for rank in range(world):
        drawn = plan.batch(index, rank, world)
        assert len(drawn) == plan.batch_size
        for trajectory, start in drawn:
            assert trajectory in members
            assert 0 <= start <= plan.frames[trajectory] - plan.length
    buffers = range(-(-len(plan.frames) // plan.buffer_size))
    assert set().union(*map(plan.members, buffers)) == set(range(len(plan.frames)))


def test_ranks_draw_every_window_once_per_pass():
    plan = WindowPlan(frames=(13, 9), length=4, batch_size=2, buffer_size=2, passes=2, seed=0)
    assert plan.batches_per_buffer(world=4) == 4
    one_pass = Counter(w for index in range(2) for rank in range(4) for w in plan.batch(index, rank, 4))
    assert set(one_pass.values()) == {1}
    assert len(one_pass) == 16


@given(plan=PLANS, legs=st.lists(st.tuples(*[st.integers(1, 7)] * 3), min_size=2, max_size=4))
@example(plan=WindowPlan((6,), 2, 1, 1, 1, 0), legs=[(1, 1, 4), (1, 1, 1)])  # one window left of five
@settings(max_examples=10, deadline=None)
def test_batches_of_another_size_continue_the_sequence(plan, legs):
    """Legs of some batches, of some size, for some ranks: no place is drawn twice or left out."""
    index, before, expected = 0, None, (0, 0)
    for batches, batch_size, world in legs:
        plan = dataclasses.replace(plan, batch_size=batch_size)
        plan = plan.resume_after(index, *before, world) if before else plan
        for number in range(index, index + batches):
            buffer, drawn = plan.locate(number, world)
            assert (buffer, drawn) in (expected, (expected[0] + 1, 0))
            if buffer > expected[0]:
                assert expected[1] > (plan.batches_per_buffer(world) - 1) * batch_size * world
            expected = (buffer, drawn + batch_size * world)
        index, before = index + batches, (batch_size, world)


def test_another_batch_size_repeats_no_window_of_a_bucket():
    resumed = dataclasses.replace(SORTED, batch_size=3).resume_after(6, 2, 1, 1)
    assert resumed.start.drawn == 16  # two whole buckets of four batches of two
    assert resumed.batch(6, 0, 1)[0] == dataclasses.replace(SORTED, bucket=1).batch(8, 0, 1)[0]


def test_a_bucket_lies_in_one_buffer_and_covers_each_batch_once():
    buckets = [SORTED.bucket_of(index, 1) for index in range(60)]
    for index, bucket in enumerate(buckets):
        assert index in bucket
        assert len({SORTED.locate(i, 1)[0] for i in bucket}) == 1
        assert all(buckets[i] == bucket for i in bucket if i < 60)


@given(plan=PLANS, index=st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_ranks_together_have_the_batch_of_one_process(plan, index):
    whole = dataclasses.replace(plan, batch_size=3 * plan.batch_size)
    parts = [plan.batch(index, rank, 3) for rank in range(3)]
    assert parts[0] + parts[1] + parts[2] == whole.batch(index, 0, 1)
    assert plan.resume_after(index, whole.batch_size, 1, 3) == plan


@pytest.mark.parametrize("wrong", [{"batch_size": 0}, {"seed": -1}, {"emphasis": -0.1}, {"openings": 1.5}])
def test_invalid_numbers_are_refused(wrong):
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))} = "):
        dataclasses.replace(SORTED, **wrong)


def test_openings_move_windows_to_the_first_frames_of_their_trajectories():
    plan = WindowPlan(frames=(60, 40, 10), length=8, batch_size=1000, buffer_size=3, passes=100, seed=0)
    plain = plan.batch(0, 0, 1)
    half, whole = (dataclasses.replace(plan, openings=share).move_to_openings(plain, 0, 0, 1) for share in (0.5, 1.0))
    assert plan.move_to_openings(plain, 0, 0, 1) == plain
    assert [trajectory for trajectory, _ in whole] == [trajectory for trajectory, _ in plain]
    for trajectory, limit in enumerate((OPENING, OPENING, 3)):
        assert {first for own, first in whole if own == trajectory} == set(range(limit))
    stayed = np.mean([one == other for one, other in zip(plain, half, strict=True)])
    assert 0.45 < stayed < 0.6
