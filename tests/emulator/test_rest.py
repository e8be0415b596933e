"""Only what lies on something rests, to the bit; what rests is not computed again; kernels beside tensor operations."""

import dataclasses

import pytest
import torch

from nmpm.decoders import Absolute
from nmpm.emulator import Emulator, RolloutOptions, unroll
from nmpm.emulator.engines.torch.support import REACH, Support
from nmpm.emulator.monitor import Monitor
from nmpm.emulator.rollouts import rollout
from nmpm.grid import Grid
from nmpm.particles import Particles, lattice, state_at_rest
from nmpm.transfer import without_kernels
from tests.scenes import CHANNEL, box, cloud, emulator_of, silenced

BUNDLES = 6
WEIGHTLESS = box(gravity=(0.0, 0.0))


def motionless(scene, **changes) -> Emulator:
    """An emulator whose network predicts that everything stands still, in the air too."""
    emulator = emulator_of(scene, decoder=Absolute(), **({"rest_speed": 0.01} | changes))
    return silenced(emulator).requires_grad_(False)


def block(scene, low: float, high: float) -> Particles:
    """A block of particles at rest between two heights along the last axis."""
    return state_at_rest(scene, lattice((((0.4, 0.6),) * (scene.dim - 1)) + ((low, high),), 0.02))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_drop_under_the_ceiling_comes_down_as_fast_as_from_rest_in_each_bundle(dim):
    scene = box(dim)
    drop = block(scene, 0.86, 0.9)
    predicted = rollout(motionless(scene), drop, 8)
    times = torch.tensor([1, 3, 6, 10, 11, 13, 16, 20])
    fallen = (drop.position.unsqueeze(1) - predicted)[..., -1]
    expected = 9.81 * scene.dt**2 * times.view(1, -1, 1).expand_as(fallen)
    torch.testing.assert_close(fallen, expected, rtol=1e-2, atol=1e-6)
    torch.testing.assert_close(predicted[..., :-1], drop.position.unsqueeze(1).expand_as(predicted)[..., :-1])


@pytest.mark.parametrize("solids", [True, False])
def test_what_lies_on_an_obstacle_stays_and_what_hangs_below_it_falls(solids):
    scene = box(obstacles=True)
    beam = lattice(((0.3, 0.7), (0.5, 0.6)), 0.01)
    above, below = (lattice(((0.4, 0.6), ends), 0.02) for ends in ((0.62, 0.7), (0.42, 0.46)))
    state = state_at_rest(scene, torch.cat([above, below]), beam)
    fallen = (state.position - rollout(motionless(scene, solids=solids), state, 8)[:, -1])[0, :, -1]
    assert (fallen[: len(above)].abs() < 1e-6).all()
    assert (fallen[len(above) :] > 1e-4).all()


@pytest.mark.parametrize(
    "scene",
    [WEIGHTLESS, box(gravity=None), box(boundary=("wall", "periodic"), domain=((0.08, 0.92), (0.1, 0.9)))],
    ids=["no gravity", "unknown gravity", "a periodic axis"],
)
def test_where_there_is_no_floor_what_rests_stays(scene):
    drop = block(scene, 0.6, 0.7)
    predicted = rollout(motionless(scene), drop, 8)
    torch.testing.assert_close(predicted, drop.position.unsqueeze(1).expand_as(predicted), rtol=0, atol=1e-7)


@pytest.mark.parametrize(("gap", "held"), [(REACH - 1, True), (REACH, False)])
def test_gaps_of_less_than_the_reach_are_bridged(gap, held):
    grid = Grid((5, 12), (0.0, 0.0), (1.0, 1.0), (False, False))
    scene = box(bounds=((0.0, 5.0), (0.0, 12.0)), domain=((0.0, 5.0), (0.0, 12.0)))
    filled = torch.zeros(1, 1, 5, 12)
    filled[..., :3] = filled[..., 3 + gap] = 1.0
    support = Support(filled, None, scene, grid).supported_cells(torch.tensor([[[0.0, -1.0]]]))
    assert support[0, 2, : 4 + min(gap, REACH - 1)].all()
    assert bool(support[0, 2, 3 + gap]) == held


PULLS = {"down": (0.0, -1.0), "to the right": (1.0, 0.0), "diagonal": (0.7, 0.7), "along a channel": (1.0, 0.0)}


@pytest.mark.parametrize("name", PULLS)
def test_kernels_and_masks_hold_the_same_particles(name, monkeypatch):
    changes = CHANNEL if "channel" in name else {}
    scene = box(2, ("water", "sand"), obstacles=True, gravity=None, gravity_varies=True, **changes)
    position = 0.11 + 0.78 * torch.rand(60, 2, generator=torch.Generator().manual_seed(2))
    emulator, state = motionless(scene), state_at_rest(scene, position, lattice(((0.3, 0.5),) * 2, 0.02))
    state = dataclasses.replace(state, gravity=9.81 * scene.dt**2 * torch.tensor([PULLS[name]]))
    fused = emulator(state).position
    with without_kernels():
        tensors = emulator(state).position
        monkeypatch.setattr("nmpm.emulator.engines.torch.advection.is_eager_cpu", lambda _: False)
        torch.testing.assert_close(emulator(state).position, tensors, rtol=0, atol=0)
    moved = (tensors[:, -1] - state.position).norm(dim=-1) > 1e-5
    assert ("channel" in name) or 0.1 < moved.float().mean() < 0.95
    torch.testing.assert_close(fused, tensors, rtol=0, atol=1e-6)


# Rollouts in which scenes come to rest


def called_each_time(emulator: Emulator, particles: Particles) -> list[torch.Tensor]:
    """Positions of the bundles when every one of them is computed."""
    context, positions = emulator.context(particles), []
    for _ in range(BUNDLES):
        bundle = emulator(particles, context)
        positions.append(bundle.position)
        particles = particles.with_motion(bundle.position[:, -1], bundle.velocity)
    return positions


def scenes_computed(emulator: Emulator) -> list[int]:
    """A list to which each call of the network adds its number of scenes."""
    sizes: list[int] = []
    emulator.processor.register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    return sizes


@pytest.mark.parametrize("rest_speed", [0.0, 1e3])
def test_a_batch_at_rest_is_not_computed_again(rest_speed):
    emulator = emulator_of(WEIGHTLESS, scale=0.01, rest_speed=rest_speed).requires_grad_(False)
    particles = cloud(WEIGHTLESS, batch=3, speed=0.01)
    expected, sizes = called_each_time(emulator, particles), scenes_computed(emulator)
    predicted = [bundle.position for bundle in unroll(emulator, particles, BUNDLES)]
    assert 1 < len(sizes) < BUNDLES if rest_speed else len(sizes) == BUNDLES
    assert all(map(torch.equal, predicted, expected))
    assert torch.equal(predicted[-1][:, -1], predicted[-2][:, -1]) == bool(rest_speed)


def test_only_scenes_that_move_are_computed():
    emulator = emulator_of(WEIGHTLESS, scale=0.01, rest_speed=0.05).requires_grad_(False)
    batch = cloud(WEIGHTLESS, batch=3, speed=0.02)
    batch.velocity[::2] = 0.0
    expected, sizes, monitor = called_each_time(emulator, batch), scenes_computed(emulator), Monitor()
    predicted = [bundle.position for bundle in unroll(emulator, batch, BUNDLES, RolloutOptions(monitor=monitor))]
    assert 0.6 < monitor.rest_share < 0.75
    assert f"{monitor.rest_share:.0%} of all at rest" in monitor.report()
    assert (sizes[0], sizes[-1]) == (3, 1)
    for one, other in zip(predicted, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
        assert torch.equal(one[::2], other[::2])
    assert not torch.equal(predicted[-1][1, -1], predicted[-2][1, -1])
