import dataclasses

import pytest
import torch

from nmpm.emulator import Emulator, EmulatorRecipe, differentiable_rollout
from nmpm.emulator.constraints import Constraints
from nmpm.errors import DataError
from nmpm.obstacles import Ramp
from nmpm.particles import Particles
from nmpm.processors import UNet
from tests.scenes import box, cloud

FRAMES = 5  # of which the last bundle is cut
FLOATS = ("position", "velocity", "gravity", "obstacle")


def emulator(**constraints) -> Emulator:
    """In float64, for finite differences; smooth: its linear interpolation has kinks, which they rarely meet."""
    torch.manual_seed(0)
    scene = box(obstacles=True, gravity=None, gravity_varies=True)
    recipe = EmulatorRecipe(scene, 16, frames=2, processor=UNet(4, 1), constraints=Constraints(**constraints))
    return recipe.build().double().eval().requires_grad_(False)


def state(angle: torch.Tensor, **changes: torch.Tensor) -> Particles:
    particles = cloud(box(obstacles=True), 12)
    obstacle = Ramp((0.5, 0.35), 0.3, 0.03, angle).particles(0.03).unsqueeze(0)
    fields = {
        "position": particles.position.double(),
        "velocity": particles.velocity.double(),
        "gravity": torch.tensor([[0.0, -6e-5]], dtype=torch.float64),
        "obstacle": obstacle,
        "obstacle_mask": torch.ones(obstacle.shape[:2], dtype=torch.bool),
    }
    return dataclasses.replace(particles, **(fields | changes))


def loss(model: Emulator, particles: Particles) -> torch.Tensor:
    return differentiable_rollout(model, particles, FRAMES)[:, -1].sub(0.5).square().sum()


@pytest.mark.parametrize("name", ["position", "velocity", "gravity"])
def test_gradients_of_the_state_are_those_of_finite_differences(name):
    model, angle = emulator(solids=False), torch.tensor(0.4, dtype=torch.float64)
    value = getattr(state(angle), name).clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda given: loss(model, state(angle, **{name: given})), value, eps=1e-7, atol=1e-5, fast_mode=True
    )


@pytest.mark.parametrize("constraints", [{}, {"density_cap": 0.5, "energy": True, "rest_speed": 0.01}])
def test_gradients_of_an_obstacle_alone_are_not_lost_to_the_kernels(constraints):
    """In float32, where rollouts without gradients take fused kernels."""

    def derivative(also_of_the_position: bool) -> torch.Tensor:
        model = emulator(**constraints).float()
        angle = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
        plain = dataclasses.replace(state(angle), **{name: getattr(state(angle), name).float() for name in FLOATS})
        position = plain.position.detach().requires_grad_(also_of_the_position)
        loss(model, dataclasses.replace(plain, position=position)).backward()
        return angle.grad

    alone = derivative(False)
    assert alone.abs() > 1e-9
    torch.testing.assert_close(alone, derivative(True), rtol=1e-4, atol=1e-9)


def test_states_are_checked():
    model, particles = emulator(), state(torch.tensor(0.0))
    with pytest.raises(ValueError, match="at least 1"):
        differentiable_rollout(model, particles, 0)
    outside = dataclasses.replace(particles, position=particles.position + 1)
    with pytest.raises(DataError, match="outside of the domain"):
        differentiable_rollout(model, outside, 2)
