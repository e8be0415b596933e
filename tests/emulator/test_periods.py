"""Particles that travel through many periods of a scene."""

import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.decoders import Flip, Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.rollouts import rollout
from nmpm.processors import Identity, Pointwise

PERIOD = 0.8
CHANNEL = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}
STILL = box(gravity=(0.0, 0.0), **CHANNEL)


def emulator_of(scene=STILL, scale=1e-9, decoder=None, **constraints):
    torch.manual_seed(0)
    network = Identity() if scale < 1e-6 else Pointwise(hidden=(4,))
    recipe = EmulatorRecipe(
        scene, 16, 4, processor=network, decoder=decoder or Flip(), constraints=Constraints(**constraints)
    )
    emulator = recipe.build().eval().requires_grad_(False)
    emulator.output_scale.fill_(scale)
    return emulator


def drifting(speed: float, periods: float = 0.0):
    """Particles that move along the periodic axis, so many periods away from the domain."""
    particles = cloud(STILL, speed=0.0)
    position, velocity = particles.position.clone(), particles.velocity.clone()
    position[..., 0] += periods * PERIOD
    velocity[..., 0] = speed * torch.linspace(0.5, 1, velocity.shape[1])
    return particles.with_motion(position, velocity)


@pytest.mark.parametrize("decoder", [Flip(), Residual()])
def test_a_slow_particle_moves_as_far_whatever_its_distance_from_the_domain(decoder):
    emulator = emulator_of(decoder=decoder)
    near, far = drifting(2e-4), drifting(2e-4, periods=100)
    moved, other = (rollout(emulator, start, 200)[:, -1] - start.position for start in (near, far))
    torch.testing.assert_close(other[..., 0], moved[..., 0], rtol=2e-3, atol=0)


def test_trajectories_are_unwrapped():
    start = drifting(0.05)
    predicted = rollout(emulator_of(), start, 400)
    expected = start.position[:, None] + start.velocity[:, None] * torch.arange(1, 401)[:, None, None]
    assert expected[:, -1].max() > 20 * PERIOD
    torch.testing.assert_close(predicted, expected, rtol=1e-4, atol=1e-4)
    assert (predicted[..., 0].diff(dim=1) > 0).all()


@pytest.mark.parametrize("varies", [False, True])
def test_energy_is_that_of_the_whole_way_fallen(varies):
    scene = box(gravity=(9.81, 0.0), gravity_varies=varies, **CHANNEL)
    emulator = emulator_of(scene, energy=True)
    start = dataclasses.replace(drifting(0.02), gravity=torch.tensor([[9.81, 0.0]]) * scene.dt**2)
    monitor = Monitor(Policy.RECORD, speed=100.0)
    predicted = rollout(emulator, start, 200, monitor)
    fallen = start.position[:, None] + start.velocity[:, None] * torch.arange(1, 201)[:, None, None]
    assert (predicted[:, -1, :, 0] >= fallen[:, -1, :, 0] - 1e-3).all()  # no energy is lost to crossings
    assert monitor.peaks["energy"] < 0.02
