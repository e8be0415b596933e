"""Scenes at rest: unrolling makes no further calls, and nothing that would still move is frozen."""

import pytest
import torch

from nmpm.emulator import Emulator, EmulatorRecipe, unroll
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.monitor import Monitor
from nmpm.particles import Particles
from nmpm.processors import UNet
from tests.scenes import box, cloud

BUNDLES = 6
WEIGHTLESS = box(gravity=(0.0, 0.0))


def emulator(rest_speed: float) -> Emulator:
    torch.manual_seed(0)
    constraints = Constraints(rest_speed=rest_speed)
    recipe = EmulatorRecipe(WEIGHTLESS, 16, 4, processor=UNet(4, 1), constraints=constraints)
    return recipe.build().eval().requires_grad_(False)


def count_calls(model: Emulator) -> list[int]:
    calls = [0]
    model.processor.register_forward_hook(lambda *_: calls.__setitem__(0, calls[0] + 1))
    return calls


def called_each_time(model: Emulator, particles: Particles, bundles: int = BUNDLES) -> list[torch.Tensor]:
    """Positions of the bundles when every one of them is computed."""
    context, positions = model.context(particles), []
    for _ in range(bundles):
        bundle = model(particles, context)
        positions.append(bundle.position)
        particles = particles.with_motion(bundle.position[:, -1], bundle.velocity)
    return positions


@pytest.mark.parametrize("batch", [1, 3])
def test_a_scene_at_rest_is_not_computed_again(batch):
    model, particles = emulator(rest_speed=1e3), cloud(WEIGHTLESS, batch=batch)
    expected, calls = called_each_time(model, particles), count_calls(model)
    found = [bundle.position for bundle in unroll(model, particles, BUNDLES)]
    assert 1 < calls[0] < BUNDLES
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_what_moves_is_computed():
    model, particles = emulator(rest_speed=0.0), cloud(WEIGHTLESS, speed=0.01)
    expected, calls = called_each_time(model, particles), count_calls(model)
    found = [bundle.position for bundle in unroll(model, particles, BUNDLES)]
    assert calls == [BUNDLES]
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def joined(*states: Particles) -> Particles:
    names = [name for name, values in vars(states[0]).items() if isinstance(values, torch.Tensor)]
    return Particles(**{name: torch.cat([getattr(state, name) for state in states]) for name in names})


def test_only_scenes_that_move_are_computed():
    model = emulator(rest_speed=0.05)
    batch = joined(*(cloud(WEIGHTLESS, speed=speed, seed=seed) for seed, speed in enumerate((0.0, 0.02, 0.0))))
    expected, sizes = called_each_time(model, batch), []
    model.processor.register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    monitor = Monitor()
    found = [bundle.position for bundle in unroll(model, batch, BUNDLES, monitor)]
    assert 0.5 < monitor.rest_share < 0.7
    assert f"{monitor.rest_share:.0%} of all at rest" in monitor.report()
    assert sizes[0] == 3
    assert sizes[-1] == 1
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
        assert torch.equal(one[::2], other[::2])
    assert not torch.equal(found[-1][1, -1], found[-2][1, -1])
