import dataclasses
import warnings

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.decoders import Absolute, Residual
from nmpm.emulator import Emulator, EmulatorRecipe, RolloutContext
from nmpm.emulator.constraints import Constraints, affordable, at_rest, energy, mass_shares
from nmpm.emulator.rollouts import differentiable_rollout, rollout, unroll
from nmpm.errors import ConfigError
from nmpm.processors import Pointwise
from nmpm.transfer import without_kernels


def emulator_of(
    scene, processor=Pointwise(hidden=(8,)), decoder=Residual(), cells=16, frames=4, **constraints
) -> Emulator:
    torch.manual_seed(0)
    held = Constraints(**constraints)
    return EmulatorRecipe(scene, cells, frames, processor=processor, decoder=decoder, constraints=held).build().eval()


def shares(count: int) -> torch.Tensor:
    return torch.full((1, count, 1), 1 / count, dtype=torch.float64)


def test_energy_of_a_particle_that_falls_is_kept():
    gravity = torch.tensor([[[0.0, -0.01]]], dtype=torch.float64)
    times = torch.arange(5, dtype=torch.float64)
    # Exact ballistics: the speed at a time, and the place.
    velocity = torch.stack([torch.full((5,), 0.3), 0.2 - 0.01 * times], dim=-1)[None, :, None]
    cells = torch.stack([0.3 * times, 0.2 * times - 0.005 * times**2], dim=-1)[None, :, None]
    values = energy(cells, velocity, gravity, shares(1))
    torch.testing.assert_close(values, values[:, :1].expand_as(values), rtol=1e-12, atol=0)
    assert values[0, 0].item() == pytest.approx((0.3**2 + 0.2**2) / 2)


@given(seed=st.integers(0, 10_000), fall=st.floats(-0.1, 0.1), allowed=st.floats(0, 2))
@settings(max_examples=30, deadline=None)
def test_steps_stay_within_the_budget_and_are_left_alone_below_it(seed, fall, allowed):
    generator = torch.Generator().manual_seed(seed)
    cells = 10 * torch.rand(1, 7, 2, generator=generator, dtype=torch.float64)
    step = torch.randn(1, 7, 2, generator=generator, dtype=torch.float64)
    gravity, share = torch.tensor([[[0.3 * fall, fall]]], dtype=torch.float64), shares(7)
    budget = energy(cells, torch.zeros_like(cells), gravity, share) + allowed
    before = torch.randn(1, 7, 2, generator=generator, dtype=torch.float64)
    held = step * affordable(cells, step, before, gravity, share, budget)
    proposed = energy(cells + step, step, gravity, share)
    assert (energy(cells + held, held, gravity, share) <= budget + 1e-9).all()
    if (proposed <= budget).all():
        assert torch.equal(held, step)


DOWN = torch.tensor([[[0.0, -0.01]]], dtype=torch.float64)


def one_frame(cells, before, step, budget, share=None):
    """Steps of one scene as the energy allows them: lists of (x, y), in float64."""
    cells, before, step = (torch.tensor([rows], dtype=torch.float64) for rows in (cells, before, step))
    share = shares(cells.shape[1]) if share is None else share
    budget = torch.tensor([budget], dtype=torch.float64)
    held = step * affordable(cells, step, before, DOWN, share, budget)
    return held[0], energy(cells + held, held, DOWN, share).item(), step[0]


def test_heavy_particles_count_by_their_mass():
    scene = box(materials=("water", "steel"), densities=(1000.0, 8000.0))
    material, mask = torch.tensor([[0, 1, 1]]), torch.tensor([[True, True, False]])
    share = mass_shares(scene, material, mask, torch.float64)
    assert share.flatten().tolist() == pytest.approx([1 / 9, 8 / 9, 0.0])
    cells, rest = [[9.0, 5.0], [30.0, 5.0]], [[0.0, 0.0], [0.0, 0.0]]
    allowed = 0.02
    two = share[:, :2]
    light, *_ = one_frame(cells, rest, [[1.0, 0.0], [0.0, 0.0]], 0.05 + allowed, two)
    heavy, *_ = one_frame(cells, rest, [[0.0, 0.0], [1.0, 0.0]], 0.05 + allowed, two)
    assert light[0, 0].item() == pytest.approx((2 * allowed * 9) ** 0.5, rel=1e-9)
    assert heavy[1, 0].item() == pytest.approx((2 * allowed * 9 / 8) ** 0.5, rel=1e-9)


def limited_everywhere(monkeypatch):
    """As on a GPU: nothing is decided by reading values back, and no kernel of the CPU runs."""
    monkeypatch.setattr("nmpm.emulator.prediction.kernels_take", lambda *_: False)
    for module in ("advection", "contact"):
        monkeypatch.setattr(f"nmpm.emulator.{module}.is_eager_cpu", lambda values: False)


@pytest.mark.parametrize("cells", [16, (16, 8)])
def test_within_the_budget_the_path_is_the_free_one_to_the_bit_on_every_device(monkeypatch, cells):
    scene = box()
    particles = cloud(scene, batch=2, speed=0.004)
    free, held = (emulator_of(scene, cells=cells, energy=on) for on in (False, True))
    assert held.budget(particles) is not None
    solid = held.solid(particles)
    limited_everywhere(monkeypatch)
    expected = free(particles)
    bundle = held(particles, RolloutContext(solid, torch.full((2,), 1e6)))
    assert torch.equal(bundle.position, expected.position)
    assert torch.equal(bundle.velocity, expected.velocity)


def test_with_and_without_branches_the_energy_limit_is_the_same_to_the_bit(monkeypatch):
    scene = box()
    emulator, particles = emulator_of(scene, energy=True), cloud(scene, batch=2)
    emulator.output_scale.mul_(3.0)
    with without_kernels():
        by_branching = rollout(emulator, particles, 24)
    limited_everywhere(monkeypatch)
    assert torch.equal(rollout(emulator, particles, 24), by_branching)


def test_gradients_through_the_energy_limit_are_finite(monkeypatch):
    scene = box()
    limited_everywhere(monkeypatch)
    particles = cloud(scene, batch=2)
    emulator = emulator_of(scene, energy=True)
    emulator.output_scale.mul_(3.0)
    for allowed in (-1e6, emulator.budget(particles)[0].item(), 1e6, float("inf")):
        position = particles.position.clone().requires_grad_()
        state = particles.with_motion(position, particles.velocity)
        budget = torch.full((2,), allowed)
        emulator(state, RolloutContext(emulator.solid(state), budget)).position.square().sum().backward()
        assert position.grad.isfinite().all()


@pytest.mark.parametrize("frames", [2, 3])
def test_what_falls_freely_is_never_at_rest(frames):
    gravity = torch.tensor([[[0.0, -0.004]]])
    times = torch.arange(1.0, frames + 1)
    top = -(frames + 1) / 2 * gravity  # the velocity with which it ends where it starts
    thrown = times.view(1, -1, 1, 1) * top.unsqueeze(1) + (times * (times + 1) / 2).view(1, -1, 1, 1) * gravity
    path = torch.cat([thrown, 0 * thrown], dim=2)
    start = torch.zeros(1, 2, 2)
    assert at_rest(start, path, 0.01, gravity).tolist() == [[False, True]]
    assert at_rest(start, path, 0.01, 0 * gravity).tolist() == [[True, True]]


def test_a_rollout_of_an_untrained_network_gains_no_energy():
    scene = box()
    particles = cloud(scene, batch=2)
    wild, tame = emulator_of(scene), emulator_of(scene, energy=True)
    for emulator in (wild, tame):
        emulator.output_scale.mul_(3.0)
    start = wild.in_cells(particles)

    def gain(emulator: Emulator) -> float:
        path = emulator.grid.to_cells(rollout(emulator, particles, 40))
        steps = path.diff(dim=1, prepend=start[0].unsqueeze(1))
        share = torch.full((2, 30, 1), 1 / 30)
        return (energy(path, steps, start[2], share) - energy(*start, share).unsqueeze(1)).max().item()

    assert gain(wild) > 1e-2
    assert gain(tame) < 1e-5


def test_what_rests_stays_to_the_bit():
    scene = box(gravity=(0.0, 0.0))
    particles = cloud(scene, speed=0.0)
    restless, resting = emulator_of(scene), emulator_of(scene, rest_speed=0.05)
    for emulator in (restless, resting):
        emulator.output_scale.fill_(0.01)
    assert not torch.equal(rollout(restless, particles, 8)[:, -1], particles.position)
    predicted = rollout(resting, particles, 8)
    torch.testing.assert_close(predicted, particles.position.unsqueeze(1).expand_as(predicted), rtol=0, atol=1e-6)


def test_nothing_is_held_in_training():
    scene = box()
    particles = cloud(scene)
    free, held = emulator_of(scene), emulator_of(scene, energy=True, rest_speed=1.0)
    results = [next(unroll(e.train(), particles, 1)).position for e in (free, held)]
    assert torch.equal(*results)
    assert held.budget(particles) is None


@pytest.mark.parametrize("roll", [rollout, differentiable_rollout])
def test_a_rollout_in_training_mode_says_that_constraints_do_not_act(roll):
    scene = box()
    particles, held = cloud(scene), emulator_of(scene, rest_speed=1.0).train()
    with pytest.warns(UserWarning, match=r"in training mode.*call emulator\.eval\(\) first"):
        roll(held, particles, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        roll(held.eval(), particles, 4)
        roll(emulator_of(scene).train(), particles, 4)  # has nothing that could act


def test_constraints_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="gravity is known"):
        emulator_of(box(gravity=None), energy=True)
    with pytest.raises(ConfigError, match="rest_speed = -1"):
        Constraints(rest_speed=-1)
    with pytest.raises(ConfigError, match="bounds = 'wrap' is not one of stop, reflect, error"):
        Constraints(bounds="wrap")


def test_a_network_is_shown_no_more_than_the_calibration_saw():
    scene = box(gravity=(0.0, 0.0))
    emulator = emulator_of(scene, decoder=Absolute())
    emulator.input_high.fill_(0.5)
    emulator.input_low.fill_(-0.5)
    crowded = cloud(scene, count=400, speed=0.0)
    centre = torch.full_like(crowded.position, 0.505)
    packed = crowded.with_motion(centre, crowded.velocity)
    denser = dataclasses.replace(
        packed, **{f.name: torch.cat([getattr(packed, f.name)] * 2, dim=1) for f in dataclasses.fields(packed)
                   if f.name in ("position", "velocity", "material", "mask")},
    )  # fmt: skip
    one, two = rollout(emulator, packed, 4)[:, -1, 0], rollout(emulator, denser, 4)[:, -1, 0]
    torch.testing.assert_close(one, two, rtol=0, atol=1e-6)
