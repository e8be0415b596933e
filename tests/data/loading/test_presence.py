"""Particles that come and go: their recordings, and windows of them."""

from itertools import islice

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.format import Split, Trajectory, write_metadata, write_split
from nmpm.data.windows import Presence, collate, find_tracks, first_frames
from nmpm.errors import DataError
from tests.made_up import buffer_of, comes_and_goes, made_up_metadata, made_up_trajectory, recordings_of

FRAMES = (16, 20, 13, 18)


@pytest.fixture
def folder(tmp_path):
    """A dataset of such trajectories; the last one is complete."""
    whole = [made_up_trajectory(frames, 12 + seed, seed) for seed, frames in enumerate(FRAMES)]
    write_split(tmp_path / "train.h5", [*(comes_and_goes(run, seed) for seed, run in enumerate(whole[:3])), whole[3]])
    write_metadata(tmp_path, made_up_metadata())
    return tmp_path


@given(seed=st.integers(0, 10**6), frames=st.integers(2, 30), particles=st.integers(1, 8), share=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_absent_particles_are_where_they_were_last_or_will_be_first(seed, frames, particles, share):
    rng = np.random.default_rng(seed)
    position = rng.random((frames, particles, 2)).astype(np.float32)
    there = rng.random((frames, particles)) < share
    position[~there] = np.nan
    presence = Presence.of(position)
    if presence is None:
        assert there.all()
        return
    filled = presence.fill(position[:, presence.ever])
    for column, particle in enumerate(np.flatnonzero(there.any(axis=0))):
        known = np.flatnonzero(there[:, particle])
        for frame in range(frames):
            before = known[known <= frame]
            source = before[-1] if len(before) else known[0]
            np.testing.assert_array_equal(filled[frame, column], position[source, particle])
        assert find_tracks(presence.present)[column].tolist() == [column, known[0], known[-1]]


@given(seed=st.integers(0, 10**6), frames=st.integers(3, 20), length=st.integers(3, 8))
@settings(max_examples=30, deadline=None)
def test_windows_start_where_particles_are(seed, frames, length):
    length = min(length, frames)
    present = np.random.default_rng(seed).random((frames, 2)) < 0.4
    inhabited = [frame for frame in range(frames - length + 1) if (present[frame] & present[frame + 1]).any()]
    for window, first in enumerate(first_frames(present, length)):
        later = [frame for frame in inhabited if frame >= window]
        assert first == (later[0] if later else inhabited[-1] if inhabited else frames - length)


@pytest.mark.parametrize("options", [{}, {"emphasis": 0.5, "openings": 0.3}, {"bucket": 3}], ids=str)
def test_windows_hold_the_particles_that_are_there_at_some_time(folder, options):
    buffer, split = buffer_of(folder, **options), Split(folder / "train.h5")
    runs = [split.read(index).position for index in range(len(split))]
    for window in islice(buffer.batches(), 16):
        assert window.frames.isfinite().all()
        present = torch.ones_like(window.frames[..., 0], dtype=torch.bool) & window.mask[:, None]
        present = present if window.present is None else window.present
        assert not (present & ~window.mask[:, None]).any()
        assert (present[:, 0] & present[:, 1]).any(dim=-1).all()
        for row in range(len(window.mask)):
            sequence = window.frames[row].masked_fill(~present[row, ..., None], torch.nan)[:, window.mask[row]].numpy()
            assert any(
                np.array_equal(np.nan_to_num(sequence), np.nan_to_num(run[first : first + 5, there]))
                for run in runs
                for first in range(len(run) - 4)
                if (there := overlapping(run, first)).sum() == sequence.shape[1]
            )


def overlapping(run: np.ndarray, first: int) -> np.ndarray:
    """(N,) whether the time between a particle's first and last frame overlaps a window of five frames."""
    there = ~np.isnan(run[..., 0])
    return there[: first + 5].any(axis=0) & there[first:].any(axis=0)


def test_a_complete_trajectory_is_the_same_beside_others(folder):
    recordings = recordings_of(folder)
    alone = collate([recordings[3]], recordings.reading, 9)
    beside = collate([recordings[0], recordings[3]], recordings.reading, 9)
    count = alone.mask.shape[1]
    assert alone.present is None
    assert torch.equal(beside.frames[1, :, :count], alone.frames[0])
    assert beside.present[1, :, :count].all()
    ever = int((~np.isnan(recordings.split.read(0).position[..., 0])).any(axis=0).sum())
    assert ever < 12
    assert not beside.present[0, :, ever:].any()
    assert beside.mask.sum(dim=1).tolist() == [ever, 15]


def test_recordings_without_a_velocity_or_an_end_are_named(folder):
    position = np.full((8, 3, 2), 0.5, np.float32)
    write_split(folder / "train.h5", [made_up_trajectory(8, 3), Trajectory(position, np.array([7, 7, 3]))])
    recordings = recordings_of(folder)
    position[1::2] = np.nan
    position[:, 2] = 0.5
    write_split(folder / "train.h5", [made_up_trajectory(8, 3), Trajectory(position, np.array([7, 7, 3]))])
    with pytest.raises(DataError, match="trajectory 00001: all positions are NaN from frame 7 on"):
        recordings[1]
    with pytest.raises(DataError, match="trajectory 00001: all positions are NaN from frame 7 on"):
        recordings.check_ends()
    position[7, :2] = 0.5
    write_split(
        folder / "train.h5",
        [made_up_trajectory(8, 3), Trajectory(position[[0, 1, 2, 3, 4, 5, 7]], np.array([7, 7, 3]))],
    )
    with pytest.raises(DataError, match="trajectory 00001: no particle is there in two successive frames"):
        recordings[1]


def test_particles_that_share_a_column_are_apart_in_windows(tmp_path):
    whole = made_up_trajectory(20, 6, fields=("heat",))
    apart, shared = whole.position.copy(), np.full((20, 4, 2), np.nan, np.float32)
    heat, number = np.zeros((20, 4)), np.full((20, 4), -1)
    for column, lives in enumerate([[(0, 9, 0), (10, 20, 1)], [(0, 5, 2), (7, 12, 3), (14, 20, 4)], [], [(0, 20, 5)]]):
        for first, end, particle in lives:
            shared[first:end, column] = whole.position[first:end, particle]
            heat[first:end, column] = whole.fields["heat"][first:end, particle]
            number[first:end, column] = particle
            apart[:first, particle] = apart[end:, particle] = np.nan
    shared[3, 3] = apart[3, 5] = np.nan  # a gap in a track
    write_metadata(tmp_path, made_up_metadata(fields=("heat",)))
    windows = []
    for position, fields in ((apart, whole.fields), (shared, {"heat": heat, "track": number})):
        stored = Trajectory(position, np.full(position.shape[1], 7), {}, fields)
        write_split(tmp_path / "train.h5", [stored])
        recordings = recordings_of(tmp_path)
        buffer = buffer_of(tmp_path, batch_size=8, buffer_size=1, passes=4.0)
        windows += [next(buffer.batches()), collate([recordings[0]], recordings.reading)]
    for one, other in ((windows[0], windows[2]), (windows[1], windows[3])):
        assert torch.equal(one.frames, other.frames)
        assert torch.equal(one.present, other.present)
        assert torch.equal(one.mask, other.mask)
        assert torch.equal(one.fields["heat"] * one.present, other.fields["heat"] * other.present)


def test_fields_of_absent_particles_may_be_unknown(folder):
    run = made_up_trajectory(8, 3, fields=("heat",))
    position, heat = run.position.copy(), run.fields["heat"].copy()
    position[2:4, 1] = heat[2:4, 1] = np.nan
    write_split(folder / "train.h5", [Trajectory(position, run.particle_type, fields={"heat": heat})])
    write_metadata(folder, made_up_metadata(fields=("heat",)))
    recording = recordings_of(folder)[0]
    expected = heat.astype(np.float32)
    expected[2:4, 1] = expected[1, 1]
    np.testing.assert_array_equal(recording.fields["heat"], expected)
    heat[5, 1] = np.nan
    write_split(folder / "train.h5", [Trajectory(position, run.particle_type, fields={"heat": heat})])
    with pytest.raises(DataError, match="heat of particle 1 in frame 5 is nan"):
        recordings_of(folder)[0]
