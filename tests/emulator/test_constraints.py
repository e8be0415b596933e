"""Energy, bounds and the network's inputs are limited in rollouts; nothing but bounds is in training."""

import dataclasses
import warnings
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.decoders import Absolute, Flip
from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.constraints import at_rest, energy, mass_shares
from nmpm.emulator.engines.torch.energy import EnergyLimit, affordable_share
from nmpm.emulator.rollouts import differentiable_rollout, rollout, unroll
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.transfer import without_kernels
from tests.scenes import box, cloud, emulator_of, padded


def test_energy_of_a_particle_that_falls_is_kept():
    gravity, times = torch.tensor([[[0.0, -0.01]]], dtype=torch.float64), torch.arange(5, dtype=torch.float64)
    velocity = torch.stack([torch.full((5,), 0.3), 0.2 - 0.01 * times], dim=-1)[None, :, None]
    cells = torch.stack([0.3 * times, 0.2 * times - 0.005 * times**2], dim=-1)[None, :, None]
    values = energy(cells, velocity, gravity, torch.ones(1, 1, 1, dtype=torch.float64))
    torch.testing.assert_close(values, values[:, :1].expand_as(values), rtol=1e-12, atol=0)
    assert values[0, 0].item() == pytest.approx((0.3**2 + 0.2**2) / 2)


def test_heavy_particles_count_by_their_mass_and_padding_not_at_all():
    scene = box(materials=("water", "steel"), densities=(1000.0, 8000.0))
    share = mass_shares(scene, torch.tensor([[0, 1, 1]]), torch.tensor([[True, True, False]]), torch.float64)
    assert share.flatten().tolist() == pytest.approx([1 / 9, 8 / 9, 0.0])


@given(seed=st.integers(0, 10_000), fall=st.floats(-0.1, 0.1), allowed=st.floats(0, 2))
@settings(max_examples=25)
def test_steps_stay_within_the_budget_and_are_left_alone_below_it(seed, fall, allowed):
    generator = torch.Generator().manual_seed(seed)
    cells = 10 * torch.rand(1, 7, 2, generator=generator, dtype=torch.float64)
    step, before = torch.randn(2, 1, 7, 2, generator=generator, dtype=torch.float64)
    share = torch.rand(1, 7, 1, generator=generator, dtype=torch.float64)
    gravity, share = torch.tensor([[[0.3 * fall, fall]]], dtype=torch.float64), share / share.sum()
    budget = energy(cells, torch.zeros_like(cells), gravity, share) + allowed
    excess = EnergyLimit(gravity, share, budget).excess(cells, step, before)
    held = step if excess is None else step * (1 - excess)
    after = energy(cells + held, held, gravity, share)
    assert (after <= budget + 1e-9).all()
    if (energy(cells + step, step, gravity, share) <= budget).all():
        assert torch.equal(held, step)
    else:
        torch.testing.assert_close(after, budget, rtol=0, atol=1e-9)  # and no less than is allowed


def test_the_affordable_part_of_a_way():
    before, after = torch.tensor([[1.0, 1.0]] * 4), torch.tensor([[1.5, 2.0], [3.0, 2.0], [0.0, 0.5], [9.0, 9.0]])
    budget = torch.tensor([2.0, 2.0, 0.7, 0.5])
    torch.testing.assert_close(affordable_share(before, after, budget), torch.tensor([1.0, 0.5, 1.0, 0.0]))


@pytest.mark.parametrize("kernels", [True, False], ids=["kernels", "tensors"])
@pytest.mark.parametrize(
    "held",
    [
        {"energy": True, "rest_speed": 0.01}, {"energy": True, "rest_speed": 0.005, "density_cap": 3.0},
        {"energy": True}, {"rest_speed": 0.02}, {"density_cap": 0.3}, {},
    ],
    ids=str,
)  # fmt: skip
@pytest.mark.parametrize("cells", [16, (12, 18)], ids=["square", "oblong"])
@torch.no_grad()
def test_a_rollout_goes_on_from_each_of_its_bundles_as_if_never_interrupted(kernels, held, cells):
    scene = box(obstacles=True)
    emulator, state = emulator_of(scene, cells, scale=2.0, **held), cloud(scene, 200, batch=2, speed=0.01, statics=9)
    with nullcontext() if kernels else without_kernels():
        whole = torch.cat([bundle.position for bundle in unroll(emulator, state, 5)], dim=1)
        for bundles in range(1, 5):
            (last,) = unroll(emulator, state, 1)
            state = last.state_after(state)
            rest = rollout(emulator, state, (5 - bundles) * emulator.frames)
            assert torch.equal(rest, whole[:, bundles * emulator.frames :])


def test_a_state_that_is_changed_has_an_energy_of_its_own():
    scene = box()
    emulator, state = emulator_of(scene, scale=2.0, energy=True), cloud(scene, batch=2)
    after = emulator(state).state_after(state)
    assert torch.equal(emulator.budget(after), emulator.budget(state))
    assert torch.equal(emulator.budget(after.scenes([1])), emulator.budget(state)[1:])
    assert torch.equal(emulator.budget(Particles.stack([after, after])), emulator.budget(state).repeat(2))
    for changed in (after.with_motion(after.position, 3 * after.velocity), dataclasses.replace(after, mask=after.mask)):
        assert changed.budget is None
        assert not torch.equal(emulator.budget(changed), emulator.budget(state))


@pytest.mark.parametrize("branching", [True, False])
@pytest.mark.parametrize("cap", [0.0, 1.0])
def test_the_energy_of_no_frame_exceeds_that_of_the_first_state(branching, cap, monkeypatch):
    """Of a wild network; where spreading what is crowded lifts it, and where it costs nothing."""
    if not branching:
        without_branches(monkeypatch)
    scene = box()
    emulator = emulator_of(scene, scale=3.0, energy=True, density_cap=cap)
    state = cloud(scene, count=200, batch=2, speed=0.0)
    low = state.position[:1] - torch.tensor([0.0, 0.35])
    state = state.with_motion(torch.cat([low.clamp(min=0.1), state.position[1:]]), state.velocity)
    share = torch.full((2, 200, 1), 1 / 200)

    def gain(model) -> float:
        cells, velocity, gravity = model.in_cells(state)
        budget, most = energy(cells, velocity, gravity, share), []
        for bundle in unroll(model, state, 10):
            path = model.grid.to_cells(bundle.position)
            steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
            cells = path[:, -1]
            end = energy(cells, model.grid.to_cell_displacement(bundle.velocity), gravity, share)
            most += [(energy(path, steps, gravity, share) - budget.unsqueeze(1)).max(), (end - budget).max()]
        return max(most).item()

    assert gain(emulator) < 1e-5
    assert gain(emulator.unconstrained()) > 1e-2


def without_branches(monkeypatch):
    """As on a GPU: nothing is decided by reading values back, and no kernel of the CPU runs."""
    monkeypatch.setattr("nmpm.emulator.engines.rules.kernels_are_on", lambda: False)
    for module in ("energy", "contact", "crowding"):
        monkeypatch.setattr(f"nmpm.emulator.engines.torch.{module}.is_eager_cpu", lambda values: False)


@pytest.mark.parametrize("scale", [0.01, 3.0])
def test_with_and_without_branches_the_energy_limit_is_the_same_to_the_bit(monkeypatch, scale):
    emulator, particles = emulator_of(box(), scale=scale, energy=True), cloud(box(), batch=2)
    with without_kernels():
        by_branching = rollout(emulator, particles, 24)
    without_branches(monkeypatch)
    assert torch.equal(rollout(emulator, particles, 24), by_branching)


def test_gradients_through_the_energy_limit_are_finite(monkeypatch):
    without_branches(monkeypatch)
    emulator, particles = emulator_of(box(), scale=3.0, energy=True), cloud(box(), batch=2)
    for allowed in (-1e6, emulator.budget(particles)[0].item(), 1e6, float("inf")):
        position = particles.position.clone().requires_grad_()
        state = particles.with_motion(position, particles.velocity)
        budget = torch.full((2,), allowed)
        emulator(state, RolloutContext(emulator.solid(state), budget)).position.square().sum().backward()
        assert position.grad.isfinite().all()


def test_what_falls_freely_is_never_at_rest():
    gravity, times = torch.tensor([[[0.0, -0.004]]]), torch.arange(1.0, 4.0)
    top = -2 * gravity  # the velocity with which it ends where it starts
    thrown = times.view(1, -1, 1, 1) * top.unsqueeze(1) + (times * (times + 1) / 2).view(1, -1, 1, 1) * gravity
    path, start = torch.cat([thrown, 0 * thrown], dim=2), torch.zeros(1, 2, 2)
    assert at_rest(start, path, 0.01, gravity).tolist() == [[False, True]]
    assert at_rest(start, path, 0.01, 0 * gravity).tolist() == [[True, True]]


@pytest.mark.parametrize("rule", ["stop", "reflect"])
def test_what_falls_stops_at_the_floor_or_comes_up_again(rule):
    emulator, particles = emulator_of(box(), scale=1e-9, bounds=rule), cloud(box())
    state = particles.with_motion(particles.position, torch.tensor([0.0, -0.03]).expand_as(particles.position))
    predicted = rollout(emulator, state, 24)
    assert predicted[..., 1].min() >= 0.1 - 1e-6
    assert (predicted[..., 1].diff(dim=1).max() > 0.01) == (rule == "reflect")


def test_a_particle_beyond_the_bounds_is_an_error_where_bounds_are():
    emulator, particles = emulator_of(box(), scale=1e-9, decoder=Flip(), bounds="error"), cloud(box(), batch=2)
    particles.velocity[1, 23] = 0.7
    with pytest.raises(ValueError, match=r"Scene 1 of the batch, particle 23: .* in frame 1 of the bundle"):
        rollout(emulator, particles, 4)


@pytest.mark.parametrize("roll", [rollout, differentiable_rollout])
def test_nothing_is_held_in_training_and_a_rollout_says_so(roll):
    particles, free = cloud(box()), emulator_of(box()).train()
    held = emulator_of(box(), energy=True, rest_speed=1.0).train()
    assert torch.equal(*(next(unroll(emulator, particles, 1)).position for emulator in (free, held)))
    with pytest.warns(UserWarning, match=r"in training mode.*call emulator\.eval\(\) first"):
        roll(held, particles, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        roll(held.eval(), particles, 4)
        roll(free, particles, 4)  # has nothing that could act


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        ({"energy": True}, "gravity is known"),
        ({"rest_speed": -1}, "rest_speed = -1"),
        ({"bounds": "wrap"}, "bounds = 'wrap' is not one of stop, reflect, error"),
        ({"density_cap": float("nan")}, "density_cap"),
    ],
    ids=str,
)
def test_constraints_that_cannot_be_are_refused(constraints, message):
    with pytest.raises(ConfigError, match=message):
        emulator_of(box(gravity=None), **constraints)


def test_a_network_is_shown_no_more_than_the_calibration_saw():
    scene = box(gravity=(0.0, 0.0))
    emulator, particles = emulator_of(scene, decoder=Absolute()), cloud(scene, count=400, speed=0.0)
    emulator.input_high.fill_(0.5)
    emulator.input_low.fill_(-0.5)
    packed = particles.with_motion(torch.full_like(particles.position, 0.505), particles.velocity)
    denser = padded(packed, packed.position[0], velocity=0.0)
    denser = dataclasses.replace(denser, mask=torch.ones_like(denser.mask))
    one, two = (rollout(emulator, state, 4)[:, -1, 0] for state in (packed, denser))
    torch.testing.assert_close(one, two, rtol=0, atol=1e-6)
