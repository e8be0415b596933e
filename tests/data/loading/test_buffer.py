import itertools
import threading
from collections import Counter
from itertools import islice

import h5py
import numpy as np
import pytest
import torch

from nmpm._support.threads import raise_if_abandoned
from nmpm.data.batches import MotionSampler
from nmpm.data.format import Split, write_split
from nmpm.data.recordings import SplitRecordings
from nmpm.data.windows import Recording
from nmpm.errors import DataError
from nmpm.scene import Scene
from tests.made_up import buffer_of, comes_and_goes

MIXED = tuple((12, size) for size in (3, 4, 40, 5, 6, 30))


def square(**facts) -> Scene:
    sides = ((0.0, 1.0),) * 2
    return Scene(bounds=sides, domain=sides, dt=0.01, materials=("water",), particle_volume=1e-3, **facts)


def test_windows_equal_the_frames_of_the_file(make_dataset):
    buffer = buffer_of(make_dataset(statics=1))
    for index, window in enumerate(islice(buffer.batches(), 20)):
        for row, (trajectory, start) in enumerate(buffer.plan.batch(index, 0, 1)):
            count = int(window.mask[row].sum())
            truth = torch.from_numpy(buffer.provider.split.read(trajectory, start, start + 5).position)
            assert torch.equal(window.frames[row, :, :count], truth[:, :count])
            assert torch.equal(window.obstacle[row], truth[0, count:])
            assert (window.frames[row, :, count:] == 0.5).all()  # padding is in the middle of the domain


@pytest.mark.parametrize("gaps", [False, True], ids=["complete", "with gaps"])
@pytest.mark.parametrize(
    ("start", "shares"),
    [(1, {}), (6, {"emphasis": 0.5, "openings": 0.3}), (15, {"emphasis": 0.5, "bucket": 4}), (40, {})],
)
def test_resumes_at_any_batch_and_ranks_together_have_the_batches_of_one_process(make_dataset, gaps, start, shares):
    folder = make_dataset(train=((12, 5), (9, 7), (14, 6), (7, 3), (8, 4)))
    if gaps:
        runs = [Split(folder / "train.h5").read(index) for index in range(5)]
        write_split(folder / "train.h5", [*map(comes_and_goes, runs[:3], range(3)), *runs[3:]])
    buffer, rank = buffer_of(folder, **shares), buffer_of(folder, **shares | {"batch_size": 2})
    straight, resumed = islice(buffer.batches(), start, start + 8), islice(buffer.batches(start), 8)
    ranks = [rank.batches(start, number, 2) for number in range(2)]
    for expected, window, *parts in zip(straight, resumed, *ranks, strict=False):
        assert torch.equal(window.mask, expected.mask)
        for name in ("frames", "present") if expected.present is not None else ("frames",):
            assert torch.equal(getattr(window, name), getattr(expected, name))
            assert torch.equal(torch.cat([getattr(part, name) for part in parts]), getattr(expected, name))
        assert (window.present is None) == (expected.present is None)


def test_closing_the_iterator_ends_its_thread(make_dataset, monkeypatch):
    buffer = buffer_of(make_dataset(train=((12, 5),) * 8))
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


def test_an_error_of_the_reading_thread_is_raised(make_dataset):
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


def test_buckets_hold_the_same_windows_with_less_padding(make_dataset):
    folder, options = make_dataset(train=MIXED), {"buffer_size": 4, "passes": 2.0, "emphasis": 0.5, "batch_size": 2}
    contents, padding = [], []
    for bucket in (4, 1):
        buffer = buffer_of(folder, bucket=bucket, **options)
        windows = list(islice(buffer.batches(), 2 * buffer.plan.batches_per_buffer(1)))
        rows = itertools.chain(*(zip(window.frames, window.mask, strict=True) for window in windows))
        contents.append([f"{frames[:, real].double().sum():.10g}" for frames, real in rows])
        padding.append(1 - sum(int(w.mask.sum()) for w in windows) / sum(w.mask.numel() for w in windows))
        assert all(int(window.mask.sum(1).max()) == window.mask.shape[1] for window in windows)
    assert Counter(contents[0]) == Counter(contents[1])
    assert contents[0] != contents[1]
    assert padding[0] < 0.6 * padding[1]


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
