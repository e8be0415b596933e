"""Trust: members that part are no longer trusted from the frame of the closed form on."""

import dataclasses

import pytest
import torch

from nmpm.emulator import RolloutOptions, predict_rollout, stream_rollout
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.trust import Trust, TrustTracker
from nmpm.errors import ConfigError, DataError
from nmpm.particles import lattice, state_at_rest
from nmpm.zoo.measures.model import calibrate_trust
from tests.scenes import box, cloud, emulator_of, window_of

SCENE = box()  # of 14 x 14 cells of 3 particle spacings
BLOCK = state_at_rest(SCENE, lattice(((0.3, 0.7), (0.4, 0.6)), 0.02))
LIMIT = Trust(limit=0.1, error=0.2, scenes=8)


def moving(state, *steps, frames=20):
    """(M, B, frames, N, D) members that move along x by steps of their own."""
    times = torch.arange(1, frames + 1).view(-1, 1)
    shift = torch.zeros(len(steps), 1, frames, 1, 2)
    for member, step in enumerate(steps):
        shift[member, 0, :, :, 0] = step * times
    return state.position[None, :, None] + shift


def test_members_that_agree_are_trusted_for_ever():
    tracker = TrustTracker(SCENE, BLOCK, LIMIT)
    for part in moving(BLOCK, 0.01, 0.01, 0.01).split(7, dim=2):
        tracker.see(part)
    assert (tracker.frames.tolist(), tracker.made) == ([20], 20)
    assert bool((tracker.regions == 20).all())
    assert "Trusted for all 20 frames" in tracker.report()


@pytest.mark.parametrize(("steps", "share"), [((0.0, 0.003), 0.003), ((0.0, 0.003, 0.006), 0.004)])
def test_a_block_beside_its_copy_disagrees_by_their_distance_over_its_width(steps, share):
    tracker = TrustTracker(SCENE, BLOCK, LIMIT)
    for part in moving(BLOCK, *steps).split(3, dim=2):
        tracker.see(part)
    expected = share * torch.arange(1, 21) / 0.4
    torch.testing.assert_close(tracker.curve[0], expected, rtol=1e-4, atol=1e-5)
    last = int((expected <= 0.1).sum())
    assert tracker.frames.tolist() == [last]
    assert tracker.report() == f"Beyond frame {last} ± {round(0.2 * last)} this scene is one of many."


def test_regions_are_lost_where_members_part():
    far = state_at_rest(SCENE, torch.cat([lattice(((lo, lo + 0.2), (lo, lo + 0.2)), 0.02) for lo in (0.1, 0.6)]))
    members = far.position[None, :, None].repeat(2, 1, 20, 1, 1)
    members[1, 0, :, 100:, 0] += 0.0019 * torch.arange(1, 21).view(-1, 1)
    tracker = TrustTracker(SCENE, far, LIMIT)
    tracker.see(members)
    assert tracker.regions.shape == (1, 4, 4)
    assert tracker.regions[0, 0, 0] == 20
    assert tracker.regions.min() < tracker.frames[0] == 20


def test_which_particle_is_where_matters_only_between_materials_and_those_that_left_do_not_count():
    first, second = (lattice(((lo, lo + 0.18), (0.4, 0.6)), 0.02) for lo in (0.2, 0.6))
    state = state_at_rest(SCENE, torch.cat([first, second]))
    members = torch.stack([torch.cat([first, second]), torch.cat([second, first])])[:, None, None]
    kinds = (torch.arange(len(first) * 2) >= len(first)).long()[None]
    left = members.clone()
    left[1] = torch.nan
    for scene, material, expected in ((SCENE, 0 * kinds, 0.0), (box(materials=("goop", "water")), kinds, 1.0)):
        tracker = TrustTracker(scene, dataclasses.replace(state, material=material), LIMIT)
        tracker.see(members)
        tracker.see(left)
        torch.testing.assert_close(tracker.curve[0], torch.tensor([expected, 1.0]))


def wild(batch=1, seed=0):
    return emulator_of(SCENE, scale=3.0), cloud(SCENE, count=200, batch=batch, seed=seed)


def rollout_until_trusted(emulator, state, frames, trust, members=None):
    tracker = TrustTracker(SCENE, state, trust)
    options = RolloutOptions(members=members, tracker=tracker, until_trusted=True)
    made = predict_rollout(emulator, state, frames, options)
    assert torch.equal(made.trusted, tracker.frames)
    return made.position, tracker


def test_a_rollout_until_it_is_trusted_is_the_beginning_of_the_full_one():
    emulator, state = wild()
    full = predict_rollout(emulator, state, 60).position
    ended, tracker = rollout_until_trusted(emulator, state, 60, Trust(limit=0.05))
    assert 0 < ended.shape[1] < 60
    assert ended.shape[1] == int(tracker.frames) % 61
    assert torch.equal(ended, full[:, : ended.shape[1]])
    whole, _ = rollout_until_trusted(emulator, state, 10, Trust(limit=1.0))
    assert torch.equal(whole, full[:, :10])


def test_a_monitor_reports_the_last_trusted_frame():
    (emulator, state), monitor = wild(), Monitor(Policy.RECORD)
    tracker = TrustTracker(SCENE, state, Trust(limit=0.05, scenes=8))
    list(stream_rollout(emulator, state, 60, RolloutOptions(monitor=monitor, tracker=tracker)))
    assert "this scene is one of many" in tracker.report()
    assert monitor.report().endswith(tracker.report())
    predict_rollout(emulator, state, 4, RolloutOptions(monitor=monitor))
    assert "trust" not in monitor.report().lower()


def test_scenes_that_are_lost_earlier_are_nan_from_then_on():
    emulator, state = wild(batch=2)
    ended, tracker = rollout_until_trusted(emulator, state, 60, Trust(limit=0.05))
    assert ended.shape[1] == int(tracker.frames.max())
    for scene, last in enumerate(tracker.frames.tolist()):
        assert ended[scene, :last].isfinite().all()
        assert ended[scene, last:].isnan().all()


def test_members_are_compared_with_each_other():
    emulator, state = wild()
    ended, tracker = rollout_until_trusted(emulator, state, 60, Trust(limit=0.05), members=4)
    full = predict_rollout(emulator, state, 60, RolloutOptions(members=4)).position
    assert torch.equal(ended, full[:, :, : int(tracker.frames)])


def test_the_limit_is_that_by_which_frames_are_nearest_to_the_true_ones():
    slopes = torch.tensor([0.001, 0.002, 0.004])
    truth = [slope * torch.arange(1, 301) for slope in slopes]
    fitted = Trust.fit([curve / 2 for curve in truth], truth)
    assert fitted.limit == pytest.approx(0.05, rel=0.03)
    assert fitted.error < 0.05
    assert fitted.scenes == 3
    calm = [torch.full((50,), 0.01)]
    never_lost = Trust.fit(calm, calm)
    assert never_lost.limit == pytest.approx(Trust().limit, rel=0.05)
    assert never_lost.error == Trust().error
    with pytest.raises(DataError, match="one recorded scene or more"):
        Trust.fit([], [])


def test_calibration_on_scenes_that_the_model_made_trusts_it_as_far_as_it_may():
    emulator, state = wild()
    path = torch.cat([(state.position - state.velocity)[:, None], state.position[:, None]], dim=1)
    window = window_of(state, torch.cat([path, predict_rollout(emulator, state, 24).position], dim=1))
    fitted = calibrate_trust(emulator, iter([window]))
    assert fitted.scenes == 1
    assert rollout_until_trusted(emulator, state, 24, fitted)[0].shape[1] == 24


def test_frames_cannot_be_trusted_without_a_tracker():
    with pytest.raises(ConfigError, match="until_trusted: a tracker says which frames are"):
        RolloutOptions(until_trusted=True)


def test_cards_state_trust_and_nonsense_is_the_default():
    assert Trust.from_card(LIMIT.to_card()) == LIMIT
    for section in (None, "much", {"limit": -1, "error": 0.1}, {"limit": 0.1}, {"limit": "x", "error": 0.1}):
        assert Trust.from_card(section) == Trust()
    assert Trust().line(30, 30).startswith("Trusted for all 30 frames")
    assert "not calibrated" in Trust().line(20, 30)
