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
    found = [bundle.position for bundle in unroll(model, batch, BUNDLES)]
    assert sizes[0] == 3
    assert sizes[-1] == 1
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
        assert torch.equal(one[::2], other[::2])
    assert not torch.equal(found[-1][1, -1], found[-2][1, -1])


def two_piles(wraps: bool) -> tuple[Emulator, Particles]:
    """A pile at rest, and one that flies to it from afar, in a channel that is much longer than the network sees."""
    walls = ("periodic", "wall") if wraps else ("wall", "wall")
    low, high = ((0.1, 3.3), (0.1, 0.9)) if wraps else ((0.08, 3.32), (0.08, 0.92))
    scene = box(gravity=(0.0, 0.0), boundary=walls, bounds=((0.1, 3.3), (0.1, 0.9)), domain=(low, high))
    torch.manual_seed(0)
    constraints = Constraints(rest_speed=0.1)
    model = EmulatorRecipe(scene, (128, 32), 4, processor=UNet(4, 1), constraints=constraints).build().eval()
    model.output_scale.mul_(0.01)
    particles = cloud(scene, 200, speed=0.0)
    particles.position[0] = 0.3 + 0.3 * torch.rand(200, 2, generator=torch.Generator().manual_seed(1))
    particles.position[0, 100:, 0] += 2.2
    particles.velocity[0, 100:, 0] = -0.035
    return model.requires_grad_(False), particles


def unroll_states(model: Emulator, particles: Particles, bundles: int):
    for bundle in unroll(model, particles, bundles):
        yield particles.with_motion(bundle.position[:, -1], bundle.velocity)


def test_the_share_of_particles_at_rest_is_measured():
    model, particles = two_piles(wraps=False)
    monitor = Monitor()
    *_, settled = unroll_states(model, particles, 3)  # the first bundles round positions
    list(unroll(model, settled, 4, monitor))
    assert monitor.rest_share == pytest.approx(0.5)
    assert "50% of all at rest" in monitor.report()
