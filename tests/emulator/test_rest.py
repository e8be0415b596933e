"""Scenes at rest: unrolling makes no further calls, and nothing that would still move is frozen."""

import dataclasses

import pytest
import torch

from nmpm.emulator import Emulator, EmulatorRecipe, unroll
from nmpm.emulator.constraints import Constraints
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


def called_each_time(model: Emulator, particles: Particles) -> list[torch.Tensor]:
    """Positions of the bundles when every one of them is computed."""
    context, positions = model.context(particles), []
    for _ in range(BUNDLES):
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


def test_one_moving_scene_keeps_its_batch_awake():
    model = emulator(rest_speed=0.05)
    resting, moving = cloud(WEIGHTLESS, speed=0.0), cloud(WEIGHTLESS, speed=0.02, seed=1)
    both = dataclasses.replace(
        resting,
        **{
            name: torch.cat([getattr(resting, name), getattr(moving, name)])
            for name in ("position", "velocity", "material", "mask", "obstacle", "obstacle_mask", "gravity")
        },
    )
    expected = called_each_time(model, both)
    found = [bundle.position for bundle in unroll(model, both, BUNDLES)]
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    assert not torch.equal(found[-1][1, -1], found[-2][1, -1])


def test_training_computes_every_bundle():
    model = emulator(rest_speed=1e3).train()
    calls = count_calls(model)
    list(unroll(model, cloud(WEIGHTLESS, speed=0.0), BUNDLES))
    assert calls == [BUNDLES]
