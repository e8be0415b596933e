"""Scores of ensembles: closed forms, and what they are if the truth could be one of the members."""

import dataclasses
import math

import pytest
import torch

from nmpm.grid import counting_grid
from nmpm.metrics.ensembles import (
    EnsembleScores,
    fair_crps,
    fair_energy_score,
    interval_coverage,
    spread_and_skill,
    truth_ranks,
)
from nmpm.metrics.quantities import front, volume_fractions
from nmpm.particles import Window
from tests.scenes import CHANNEL, box, cloud

DRAWS = 40_000


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize("truth", [0.0, 1.5])
def test_the_score_of_gaussian_members_is_the_analytic_one_for_any_number(count, truth):
    density, below = math.exp(-(truth**2) / 2) / math.sqrt(2 * math.pi), (1 + math.erf(truth / math.sqrt(2))) / 2
    analytic = truth * (2 * below - 1) + 2 * density - 1 / math.sqrt(math.pi)
    scores = fair_crps(normal(count, DRAWS), torch.full((DRAWS,), truth, dtype=torch.float64))
    assert float(scores.mean()) == pytest.approx(analytic, abs=0.01)


def test_scores_compare_all_pairs_of_members_once():
    members, truth = normal(4, 3), normal(3, seed=1)
    pairs = [(i, j) for i in range(4) for j in range(i)]
    apart = sum((members[i] - members[j]).abs() for i, j in pairs) / len(pairs)
    torch.testing.assert_close(fair_crps(members, truth), (members - truth).abs().mean(0) - apart / 2)
    norm = lambda values: values.square().mean(-1).sqrt()  # noqa: E731
    apart = sum(norm(members[i] - members[j]) for i, j in pairs) / len(pairs)
    torch.testing.assert_close(fair_energy_score(members, truth), norm(members - truth).mean() - apart / 2)


def test_one_member_has_its_distance():
    member, truth = normal(1, 3), normal(3, seed=1)
    assert torch.equal(fair_crps(member, truth), (member[0] - truth).abs())
    assert float(fair_energy_score(member, truth)) == pytest.approx(float((member[0] - truth).square().mean().sqrt()))


@pytest.mark.parametrize("count", [2, 8])
def test_a_truth_that_could_be_a_member_has_its_spread_ranks_and_coverage(count):
    members, truth = normal(count, DRAWS), normal(DRAWS, seed=1)
    spread, skill = spread_and_skill(members, truth)
    assert float(spread / skill) == pytest.approx(1, abs=0.03)
    ranks = truth_ranks(members, truth, torch.Generator().manual_seed(0)).bincount(minlength=count + 1)
    assert (ranks / DRAWS - 1 / (count + 1)).abs().max() < 0.01
    for percent in (50, 90):
        assert float(interval_coverage(members, truth, percent).mean()) == pytest.approx(percent / 100, abs=0.01)
        rounded = interval_coverage(members.round(), truth.round(), percent)
        assert float(rounded.mean()) == pytest.approx(percent / 100, abs=0.01)


def test_ties_are_broken_evenly():
    ranks = truth_ranks(torch.zeros(3, DRAWS), torch.zeros(DRAWS), torch.Generator().manual_seed(0))
    assert (ranks.bincount(minlength=4) / DRAWS - 0.25).abs().max() < 0.01


def test_a_truth_outside_of_many_members_is_not_covered():
    assert float(interval_coverage(normal(40, 1), torch.tensor([9.0], dtype=torch.float64), 90)) == 0


def test_densities_are_volume_fractions_by_material():
    scene = box(materials=("water", "sand"))
    state = cloud(scene, 50)
    grid, material = counting_grid(scene), state.material[0]
    fractions = volume_fractions(scene, grid, state.position.double(), material, torch.full((50,), 2.0))
    volumes = fractions.sum((0, 2, 3)) * grid.cell_volume / scene.particle_volume
    assert volumes.tolist() == pytest.approx([2.0 * int((material == kind).sum()) for kind in (0, 1)])


def test_the_front_is_the_distance_from_the_start_across_gravity():
    scene, down = box(**CHANNEL), torch.tensor([0.0, -1.0], dtype=torch.float64)
    start = torch.tensor([[0.3, 0.5], [0.5, 0.5]], dtype=torch.float64)
    moved = torch.stack([start + torch.tensor([0.1, 0.2]), start + torch.tensor([0.8, 0.0])])
    assert front(scene, start, moved, down, torch.ones(2)).tolist() == pytest.approx([0.2, 0.1])


def window_and_members(count: int) -> tuple[Window, torch.Tensor]:
    scene = box()
    state = cloud(scene, 40)
    steps = torch.arange(-1, 13).view(1, -1, 1, 1)
    window = dataclasses.replace(Window.of(state), frames=state.position.unsqueeze(1) + steps * state.velocity)
    return window, window.target + 0.01 * normal(count, 12, 40, 2).float()


def test_scores_of_rollouts_do_not_depend_on_the_parts_they_come_in():
    window, members = window_and_members(3)
    whole, parts = EnsembleScores(box(), (1, 4, 50)), EnsembleScores(box(), (1, 4, 50))
    whole.update(window, [members])
    parts.update(window, members.split(5, dim=1))
    scores = whole.compute()
    assert scores == parts.compute()
    assert scores["mse@4"] == pytest.approx(float((members - window.target)[:, :4].square().mean()), rel=1e-5)
    assert {name.partition("_")[2] for name in scores if name.startswith("crps")} == {
        f"{quantity}{frame}" for quantity in ("density", "front", "height", "kinetic") for frame in ("@1", "@4", "")
    }
    assert int(whole.ranks["height@4"].sum()) == 1
    assert scores["spread_skill_density"] > 0


def test_a_recorded_member_alone_has_no_error_and_no_spread():
    window, _ = window_and_members(1)
    scores = EnsembleScores(box(), (4,))
    scores.update(window, [window.target])
    assert set(scores.compute().values()) == {0.0}
    assert not any("spread" in name or "coverage" in name for name in scores.compute())
    assert not scores.ranks


def test_of_particles_that_come_and_go_the_density_of_those_that_are_there_is_scored():
    window, members = window_and_members(2)
    window.present = torch.ones(1, 14, 40, dtype=torch.bool)
    window.present[:, 8:, :5] = False
    members[:, 6:, :5] = torch.nan
    scores = EnsembleScores(box(), (4,))
    scores.update(window, [members])
    assert {name.partition("_")[2] for name in scores.compute() if name.startswith("crps")} == {"density@4", "density"}
    assert all(math.isfinite(value) for value in scores.compute().values())


def test_members_that_do_not_fit_are_refused():
    window, members = window_and_members(3)
    scores = EnsembleScores(box(), (4,))
    with pytest.raises(ValueError, match="11 frames, of 12 to predict"):
        scores.update(window, [members[:, :11]])
    scores.update(window, [members])
    with pytest.raises(ValueError, match="2 members after scenes of 3"):
        scores.update(window, [members[:2]])
