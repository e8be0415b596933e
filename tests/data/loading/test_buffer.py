import dataclasses
import threading
from collections import Counter
from itertools import islice

import h5py
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nmpm._support.threads import raise_if_abandoned
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import Split, read_metadata
from nmpm.data.loading.buffer import MotionSampler, TrajectoryBuffer
from nmpm.data.loading.recording import Recording, SplitRecordings
from nmpm.data.loading.window_plan import OPENING, WindowPlan
from nmpm.data.scene_inference import infer_scene
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Scene

PLANS = st.builds(
    WindowPlan,
    frames=st.lists(st.integers(6, 30), min_size=1, max_size=12).map(tuple),
    length=st.integers(2, 6),
    batch_size=st.integers(1, 9),
    buffer_size=st.integers(1, 5),
    passes=st.sampled_from([0.3, 1, 4]),
    seed=st.integers(0, 2**40),
)


def square(**facts) -> Scene:
    sides = ((0.0, 1.0),) * 2
    return Scene(bounds=sides, domain=sides, dt=0.01, materials=("water",), particle_volume=1e-3, **facts)


def recordings_of(folder) -> SplitRecordings:
    return SplitRecordings(Split(folder / "train.h5"), read_metadata(folder), infer_scene(folder))


def buffer_of(folder, length: int = 5, **options) -> TrajectoryBuffer:
    recordings = recordings_of(folder)
    known = {"batch_size": 4, "buffer_size": 2, "passes": 1.0, "seed": 0}
    frames = tuple(map(recordings.split.frames, range(len(recordings))))
    return TrajectoryBuffer(recordings, WindowPlan(frames=frames, length=length, **(known | options)))


class TestPlan:
    @given(plan=PLANS, index=st.integers(0, 500), world=st.integers(1, 4))
    @settings(max_examples=30, deadline=None)
    def test_windows_lie_inside_trajectories_of_the_buffer(self, plan, index, world):
        for rank in range(world):
            members = plan.members(index // plan.batches_per_buffer(world))
            drawn = plan.batch(index, rank, world)
            assert len(drawn) == plan.batch_size
            for trajectory, start in drawn:
                assert trajectory in members
                assert 0 <= start <= plan.frames[trajectory] - plan.length

    @given(plan=PLANS)
    @settings(max_examples=10, deadline=None)
    def test_buffers_cover_all_trajectories(self, plan):
        total = len(plan.frames)
        for buffer in range(5):
            members = plan.members(buffer)
            assert len(set(members)) == len(members) <= min(plan.buffer_size, total)
        seen = set().union(*(plan.members(buffer) for buffer in range(-(-total // plan.buffer_size))))
        assert seen == set(range(total))

    def test_ranks_draw_every_window_once_per_pass(self):
        plan = WindowPlan(frames=(13, 9), length=4, batch_size=2, buffer_size=2, passes=2, seed=0)
        assert plan.batches_per_buffer(world=4) == 4
        one_pass = Counter(w for index in range(2) for rank in range(4) for w in plan.batch(index, rank, 4))
        assert set(one_pass.values()) == {1}
        assert len(one_pass) == 16

    @given(plan=PLANS, legs=st.lists(st.tuples(*[st.integers(1, 7)] * 3), min_size=2, max_size=4))
    @example(plan=WindowPlan((6,), 2, 1, 1, 1, 0), legs=[(1, 1, 4), (1, 1, 1)])  # one window left of five
    @settings(max_examples=30, deadline=None)
    def test_batches_of_another_size_continue_the_sequence(self, plan, legs):
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

    @given(plan=PLANS, index=st.integers(0, 99))
    @settings(max_examples=30, deadline=None)
    def test_ranks_together_have_the_batch_of_one_process(self, plan, index):
        whole = dataclasses.replace(plan, batch_size=3 * plan.batch_size)
        parts = [plan.batch(index, rank, 3) for rank in range(3)]
        assert parts[0] + parts[1] + parts[2] == whole.batch(index, 0, 1)
        assert plan.resume_after(index, whole.batch_size, 1, 3) == plan

    @pytest.mark.parametrize("wrong", [{"batch_size": 0}, {"seed": -1}, {"emphasis": -0.1}, {"openings": 1.5}])
    def test_invalid_numbers_are_refused(self, wrong):
        known = {"frames": (9,), "length": 3, "batch_size": 2, "buffer_size": 2, "passes": 1, "seed": 0}
        with pytest.raises(ConfigError, match=f"{next(iter(wrong))} = "):
            WindowPlan(**(known | wrong))


class TestBuffer:
    def test_windows_equal_the_frames_of_the_file(self, make_dataset):
        buffer = buffer_of(make_dataset(statics=1))
        for index, window in enumerate(islice(buffer.batches(), 20)):
            for row, (trajectory, start) in enumerate(buffer.plan.batch(index, 0, 1)):
                count = int(window.mask[row].sum())
                truth = torch.from_numpy(buffer.provider.split.read(trajectory, start, start + 5).position)
                assert torch.equal(window.frames[row, :, :count], truth[:, :count])
                assert torch.equal(window.obstacle[row], truth[0, count:])

    @pytest.mark.parametrize(("start", "shares"), [(1, {}), (5, {}), (6, {"emphasis": 0.5, "openings": 0.3}), (40, {})])
    def test_resumes_at_any_batch(self, make_dataset, start, shares):
        buffer = buffer_of(make_dataset(train=((12, 5), (9, 7), (14, 6), (7, 3), (8, 4))), **shares)
        straight = list(islice(buffer.batches(), start + 8))
        resumed = list(islice(buffer.batches(start), 8))
        for expected, window in zip(straight[start:], resumed, strict=True):
            assert torch.equal(window.frames, expected.frames)
            assert torch.equal(window.mask, expected.mask)

    def test_closing_the_iterator_ends_its_thread(self, make_dataset, monkeypatch):
        buffer = buffer_of(make_dataset(train=((12, 5),) * 8), buffer_size=2)
        before, read_ahead, original = set(threading.enumerate()), threading.Event(), SplitRecordings.load

        def slow(recordings, indices):
            if threading.current_thread() is threading.main_thread():
                return original(recordings, indices)
            read_ahead.set()
            while True:
                raise_if_abandoned()

        monkeypatch.setattr(SplitRecordings, "load", slow)
        batches = buffer.batches()
        next(batches)
        assert read_ahead.wait(60)
        batches.close()
        assert set(threading.enumerate()) <= before

    def test_an_error_of_the_reading_thread_is_raised(self, make_dataset):
        folder = make_dataset(train=((12, 5),) * 8)
        buffer = buffer_of(folder, buffer_size=1)
        later = buffer.plan.members(1)[0]
        with h5py.File(folder / "train.h5", "a") as file:
            file[f"{later:05d}/position"][3, 2, 0] = float("nan")
        batches = buffer.batches()
        for _ in range(buffer.plan.batches_per_buffer(1)):
            next(batches)
        with pytest.raises(DataError, match=f"trajectory {later:05d}: position of particle 2 in frame 3"):
            next(batches)


def test_emphasis_draws_windows_in_proportion_to_their_motion():
    frames = torch.zeros(40, 3, 2)
    frames[:10] = torch.arange(10).view(-1, 1, 1) * 0.01  # moves for 10 frames, then rests
    frames[10:] = frames[9]
    recording = Recording(frames, torch.zeros(3, dtype=torch.long), torch.zeros(0, 2), torch.zeros(2))
    motion = MotionSampler({7: recording}, square(), length=4)
    rng = np.random.default_rng(0)
    drawn = [motion.window_at(share) for share in rng.random(4000)]
    assert {trajectory for trajectory, _ in drawn} == {7}
    starts = np.bincount([start for _, start in drawn], minlength=37) / 4000
    expected = np.array([min(3, max(0, 9 - start)) for start in range(37)]) / 24
    np.testing.assert_allclose(starts, expected, atol=0.03)


def test_emphasis_does_not_take_the_way_across_a_periodic_border_for_motion():
    time = torch.arange(40).view(-1, 1, 1)

    def recorded(start, speed):
        frames = torch.cat([(start + speed * time).remainder(1.0), torch.full((40, 1, 1), 0.5)], -1)
        return Recording(frames, torch.zeros(1, dtype=torch.long), torch.zeros(0, 2), torch.zeros(2))

    slow, quick = recorded(0.99, 0.001), recorded(0.2, 0.01)  # the slow one crosses the border
    motion = MotionSampler({0: slow, 1: quick}, square(boundary=("periodic", "wall")), length=10)
    share = motion.cumulative[30] / motion.cumulative[-1]
    np.testing.assert_allclose(share, 1 / 11, rtol=1e-4)


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


def test_with_openings_ranks_together_have_the_batch_of_one_process(make_dataset):
    folder = make_dataset()
    of = {
        size: TrajectoryDataModule(path=str(folder), horizon=4, batch_size=size, emphasis=0.3, openings=0.5)
        for size in (2, 6)
    }
    parts = [of[2].train_dataloader().buffer.batches(rank=rank, world=3) for rank in range(3)]
    for *ranks, whole in islice(zip(*parts, of[6].train_dataloader().buffer.batches(), strict=True), 12):
        assert torch.equal(torch.cat([part.frames for part in ranks]), whole.frames)
