"""Buckets: windows of similar numbers of particles in a batch, each drawn as often as without."""

import itertools
from collections import Counter
from dataclasses import replace

import pytest

from nmpm.data.format import Split, write_metadata, write_split
from nmpm.data.loading.buffer import TrajectoryBuffer
from nmpm.data.loading.recording import SplitRecordings
from nmpm.data.loading.window_plan import WindowPlan
from nmpm.data.scene_inference import infer_scene
from tests.made_up import made_up_metadata, made_up_trajectory

SIZES = (3, 4, 40, 5, 6, 30)
PLAN = WindowPlan(frames=(12,) * 6, length=6, batch_size=2, buffer_size=4, passes=2.0, seed=1, bucket=4)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mixed")
    write_split(folder / "train.h5", [made_up_trajectory(12, size, seed=i) for i, size in enumerate(SIZES)])
    write_metadata(folder, made_up_metadata())
    return SplitRecordings(Split(folder / "train.h5"), made_up_metadata(), infer_scene(folder))


def windows_of(recordings, plan, count, start=0, rank=0, world=1):
    batches = TrajectoryBuffer(recordings, plan).batches(start, rank, world)
    windows = list(itertools.islice(batches, count))
    batches.close()
    return windows


def keys(windows):
    """One text for each window of each batch, whatever its padding."""
    return [
        [f"{frames[:, real].double().sum():.10g}" for frames, real in zip(window.frames, window.mask, strict=True)]
        for window in windows
    ]


def padding(windows):
    """Share of the particles that are padding."""
    real, all_ = sum(int(w.mask.sum()) for w in windows), sum(w.mask.numel() for w in windows)
    return 1 - real / all_


def test_a_buffer_draws_the_same_windows_in_company_of_their_size(recordings):
    plan = replace(PLAN, emphasis=0.5)
    count = 2 * plan.batches_per_buffer(1)
    sorted_, plain = windows_of(recordings, plan, count), windows_of(recordings, replace(plan, bucket=1), count)
    assert Counter(itertools.chain(*keys(sorted_))) == Counter(itertools.chain(*keys(plain)))
    assert keys(sorted_) != keys(plain)
    assert padding(sorted_) < 0.6 * padding(plain)
    assert all(int(window.mask.sum(1).max()) == window.mask.shape[1] for window in sorted_)


def test_a_bucket_lies_in_one_buffer_and_covers_each_batch_once():
    buckets = [PLAN.bucket_of(index, 1) for index in range(60)]
    for index, bucket in enumerate(buckets):
        assert index in bucket
        assert len({PLAN.locate(i, 1)[0] for i in bucket}) == 1
        assert all(buckets[i] == bucket for i in bucket if i < 60)


def test_batches_depend_on_their_index_alone(recordings):
    whole = keys(windows_of(recordings, PLAN, 20))
    for start in (3, 15):
        assert keys(windows_of(recordings, PLAN, 20 - start, start)) == whole[start:]


def test_the_ranks_together_have_the_batches_of_one_process(recordings):
    plan = replace(PLAN, emphasis=0.5)
    parts = [windows_of(recordings, plan, 8, rank=rank, world=2) for rank in range(2)]
    one = windows_of(recordings, replace(plan, batch_size=4), 8)
    for left, right, both in zip(*parts, one, strict=True):
        assert keys([left])[0] + keys([right])[0] == keys([both])[0]
        assert left.frames.shape[2] == right.frames.shape[2] == both.frames.shape[2]


def test_another_batch_size_repeats_no_window_of_a_bucket():
    resumed = replace(PLAN, batch_size=3).resume_after(6, 2, 1, 1)
    assert resumed.start.drawn == 16  # two whole buckets of four batches of two
    whole = replace(PLAN, bucket=1)
    assert resumed.batch(6, 0, 1)[0] == whole.batch(8, 0, 1)[0]
