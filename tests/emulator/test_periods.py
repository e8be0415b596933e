"""Particles that travel through many periods of a scene."""

import dataclasses

import pytest
import torch

from nmpm.decoders import Flip, Residual
from nmpm.emulator import RolloutOptions
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.emulator.rollouts import rollout
from nmpm.processors import Identity
from tests.scenes import CHANNEL, box, cloud, emulator_of

PERIOD = 0.8
STILL = box(gravity=(0.0, 0.0), **CHANNEL)
SILENT = {"processor": Identity(), "scale": 1e-9}


def drifting(speed: float, periods: float = 0.0):
    """Particles that move along the periodic axis, so many periods away from the domain."""
    particles = cloud(STILL, speed=0.0)
    position, velocity = particles.position.clone(), particles.velocity.clone()
    position[..., 0] += periods * PERIOD
    velocity[..., 0] = speed * torch.linspace(0.5, 1, velocity.shape[1])
    return particles.with_motion(position, velocity)


@pytest.mark.parametrize("decoder", [Flip(), Residual()])
def test_a_slow_particle_moves_as_far_whatever_its_distance_from_the_domain(decoder):
    emulator = emulator_of(STILL, decoder=decoder, **SILENT)
    near, far = drifting(2e-4), drifting(2e-4, periods=100)
    moved, other = (rollout(emulator, start, 200)[:, -1] - start.position for start in (near, far))
    torch.testing.assert_close(other[..., 0], moved[..., 0], rtol=2e-3, atol=0)


@pytest.mark.parametrize("bounds", ["stop", "reflect", "error"])
def test_trajectories_are_unwrapped_and_have_no_bounds(bounds):
    start = drifting(0.05)
    predicted = rollout(emulator_of(STILL, decoder=Flip(), bounds=bounds, **SILENT), start, 200)
    expected = start.position[:, None] + start.velocity[:, None] * torch.arange(1, 201)[:, None, None]
    assert expected[:, -1].max() > 10 * PERIOD
    torch.testing.assert_close(predicted, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("varies", [False, True])
def test_energy_is_that_of_the_whole_way_fallen(varies):
    scene = box(gravity=(9.81, 0.0), gravity_varies=varies, **CHANNEL)
    emulator, monitor = emulator_of(scene, decoder=Flip(), energy=True, **SILENT), Monitor(Policy.RECORD, speed=100.0)
    start = dataclasses.replace(drifting(0.02), gravity=torch.tensor([[9.81, 0.0]]) * scene.dt**2)
    end, free = (
        rollout(emulator, start, 200, RolloutOptions(monitor=monitor))[:, -1],
        start.position + 200 * start.velocity,
    )
    assert (end[..., 0] >= free[..., 0] - 1e-3).all()  # no energy is lost to crossings
    assert monitor.peaks["energy"] < 0.02
