"""The loss of several members: fair, proper, and of the particles that count."""

import dataclasses

import pytest
import torch

from nmpm.emulator import Rollout
from nmpm.particles import Window
from nmpm.training.losses import PositionLoss
from nmpm.training.module import repeated
from tests.scenes import box, cloud, emulator_of, window_of

SCENE = box(evolving=("heat",))
EMULATOR = emulator_of(SCENE, 42, 2)
GRID = EMULATOR.grid


def window(batch=2, count=6, frames=4):
    state = cloud(SCENE, count=count, batch=batch)
    path = state.position.unsqueeze(1).expand(-1, frames, -1, -1)
    return window_of(state, path)


def moved(window, cells):
    """Predictions (B M, T, N, D) of members that are moved along x by cells (M,)."""
    shift = torch.zeros(len(cells), 1, 1, 2)
    shift[:, 0, 0, 0] = torch.tensor(cells) * GRID.spacing[0]
    return (window.target.unsqueeze(1) + shift).flatten(0, 1)


def score(window, predicted, density_weight=0.0):
    return PositionLoss(0.5, density_weight)(Rollout(predicted, {}), window, EMULATOR)


def test_members_score_their_distance_to_the_truth_less_half_of_that_between_them():
    truth = window()
    # Root mean squares over two axes: 3 / √2 and 1 / √2 to the truth, 4 / √2 between members on either side of it.
    assert score(truth, moved(truth, [3.0, -1.0])).item() == pytest.approx((2 - 4 / 2) / 2**0.5, abs=0.01)
    assert score(truth, moved(truth, [3.0, 1.0])).item() == pytest.approx((2 - 2 / 2) / 2**0.5, abs=0.01)
    three = score(truth, moved(truth, [3.0, 1.0, -1.0]))
    assert three.item() == pytest.approx((5 / 3 - (2 + 4 + 2) / 6) / 2**0.5, abs=0.01)


@pytest.mark.parametrize("members", [2, 5])
def test_a_spread_like_that_of_the_truth_scores_best(members):
    torch.manual_seed(0)
    truth = window(batch=2000, count=1, frames=4)
    still = truth.target.repeat_interleave(members, 0)
    moved = GRID.spacing[0] * torch.randn(len(truth.frames), 1, 1, 2)
    truth = dataclasses.replace(truth, frames=truth.frames + moved)
    scores = {
        spread: score(truth, still + spread * GRID.spacing[0] * torch.randn(len(still), 1, 1, 2)).item()
        for spread in (0.5, 1.0, 2.0)
    }
    assert scores[1.0] < min(scores[0.5], scores[2.0])
    # E|x - y| - E|x - x'| / 2 of normal positions in two axes: √π - √π / 2, over √2 for the root mean square.
    assert scores[1.0] == pytest.approx((torch.pi / 2) ** 0.5 / 2, rel=0.05)


def test_densities_are_scored_by_the_share_that_lies_in_other_cells():
    truth = window(count=1)
    corner = GRID.to_length(torch.tensor([10.5, 10.5]))
    truth = dataclasses.replace(truth, frames=corner.expand_as(truth.frames))
    alone = score(truth, moved(truth, [0.0, 2.0]))
    with_density = score(truth, moved(truth, [0.0, 2.0]), density_weight=1.0)
    assert (with_density - alone).item() == pytest.approx(1 / 2 - 1 / 2, abs=1e-5)  # one of two is right
    both = score(truth, moved(truth, [2.0, 2.0]), density_weight=1.0) - score(truth, moved(truth, [2.0, 2.0]))
    assert both.item() == pytest.approx(1.0, abs=1e-5)


def test_padding_and_absent_particles_do_not_count():
    truth = window(count=6)
    fewer = dataclasses.replace(
        truth, frames=truth.frames[:, :, :-1], mask=truth.mask[:, :-1], material=truth.material[:, :-1]
    )
    expected = score(fewer, moved(fewer, [3.0, 1.0]), density_weight=1.0)
    mask, broken = truth.mask.clone(), moved(truth, [3.0, 1.0])
    mask[:, -1] = False
    broken[:, :, -1] += 0.1
    padded = dataclasses.replace(truth, mask=mask)
    torch.testing.assert_close(score(padded, broken, density_weight=1.0), expected)
    present = mask.unsqueeze(1).expand(truth.frames.shape[:3]).contiguous()
    absent = dataclasses.replace(truth, present=present)
    torch.testing.assert_close(score(absent, broken, density_weight=1.0), expected)


def test_fields_are_scored_in_units_of_their_spread():
    truth = dataclasses.replace(window(), fields={"heat": torch.zeros(2, 1, 6)})
    heat = torch.tensor([3.0, 1.0]).repeat(2).view(4, 1, 1).expand(4, 2, 6)
    emulator = emulator_of(SCENE, 42, 2)
    emulator.field_scales.std.fill_(2.0)
    members = Rollout(truth.target.repeat_interleave(2, 0), {"heat": heat, "other": heat})
    of_fields = PositionLoss(0.5, 0.0)(members, truth, emulator) - score(truth, members.position)
    assert of_fields.item() == pytest.approx((2 - 2 / 2) / 2, abs=0.01)


def test_windows_are_repeated_one_after_the_other():
    pair = window()
    assert torch.equal(repeated(pair, 3).frames[:3], pair.frames[:1].expand(3, -1, -1, -1))
    assert repeated(pair, 1) is pair
    assert isinstance(repeated(pair, 2), Window)
