"""Members of a rollout: each depends on the seed, its number and its scene; nudges respect bounds and obstacles."""

import dataclasses

import pytest
import torch

from nmpm.emulator import Prescribed, RolloutOptions, predict_rollout, stream_rollout
from nmpm.emulator.adaptation import with_noise
from nmpm.emulator.members import MOST_SCENES, member_starts
from nmpm.emulator.monitor import Monitor, Policy
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.processors import UNet
from tests.scenes import CHANNEL, box, cloud, emulator_of, padded, with_obstacle


@pytest.fixture(params=["nudged", "noisy"])
def emulator(request):
    emulator = emulator_of(box(), processor=UNet(width=6, depth=1, perceptron=(5,)), scale=0.1)
    if request.param == "nudged":
        return emulator
    noisy = with_noise(emulator)
    first = noisy.processor.get_parameter(f"{noisy.processor.channel_layers.first}.weight")
    torch.nn.init.normal_(first, std=0.3, generator=torch.Generator().manual_seed(0))
    return noisy


def test_a_member_depends_on_seed_number_and_scene_alone(emulator):
    two = Particles.stack([cloud(box(), count=40), cloud(box(), count=25, seed=1)])
    few = predict_rollout(emulator, two, 10, RolloutOptions(members=2, seed=3)).position
    many = predict_rollout(emulator, two, 10, RolloutOptions(members=2 * MOST_SCENES, seed=3)).position
    assert few.shape == (2, 2, 10, 40, 2)
    torch.testing.assert_close(many[:2], few, rtol=1e-5, atol=1e-6)
    alone = predict_rollout(emulator, cloud(box(), count=40), 10, RolloutOptions(members=2, seed=3)).position
    torch.testing.assert_close(alone[:, 0], few[:, 0], rtol=1e-5, atol=1e-6)
    other = predict_rollout(emulator, two, 10, RolloutOptions(members=2, seed=4)).position
    assert min(float((a - b).abs().max()) for a, b in [(few[0], few[1]), (few, other)]) > 1e-3


def test_parts_are_the_frames_of_all_members(emulator):
    state = cloud(box(), batch=3, count=20)
    parts = list(stream_rollout(emulator, state, 6, RolloutOptions(members=4)))
    assert [tuple(part.position.shape) for part in parts] == [(12, 4, 20, 2), (12, 2, 20, 2)]
    whole = predict_rollout(emulator, state, 6, RolloutOptions(members=4)).position
    assert torch.equal(torch.cat([part.position for part in parts], dim=1).unflatten(0, (4, 3)), whole)
    assert predict_rollout(emulator, state, 0, RolloutOptions(members=4)).position.shape == (4, 3, 0, 20, 2)
    assert predict_rollout(emulator, state.scenes([]), 5, RolloutOptions(members=4)).position.shape == (4, 0, 5, 20, 2)


def test_without_nudge_each_member_is_the_deterministic_rollout():
    emulator = emulator_of(box(), processor=UNet(width=6, depth=1, perceptron=(5,)))
    state = cloud(box(), batch=2)
    one = predict_rollout(emulator, state, 9).position
    members = predict_rollout(emulator, state, 9, RolloutOptions(members=3, nudge=0)).position
    assert all(torch.equal(member, one) for member in members)


def test_nudges_are_gaussian_and_velocities_stay(emulator):
    state = padded(cloud(box(), count=2000, batch=2), torch.tensor([[0.5, 0.5]] * 3))
    starts = member_starts(emulator, state, members=4, seed=1, nudge=0.2)
    shift = (starts.position - state.position.repeat(4, 1, 1)) / torch.tensor(emulator.grid.spacing)
    real = shift[:, :2000]
    assert float(real.std()) == pytest.approx(0.2, rel=0.02)
    assert float(real.mean()) == pytest.approx(0, abs=0.005)
    assert torch.equal(shift[:, 2000:], torch.zeros_like(shift[:, 2000:]))
    assert torch.equal(starts.velocity, state.velocity.repeat(4, 1, 1))
    double = member_starts(emulator, state.double(), members=4, seed=1, nudge=0.2)
    assert double.position.dtype == torch.float64
    torch.testing.assert_close(double.position.float(), starts.position)


def test_nudged_particles_stay_within_bounds_and_out_of_obstacles():
    scene = box(obstacles=True)
    wall = torch.stack(torch.meshgrid(torch.arange(0.4, 0.6, 0.01), torch.arange(0.4, 0.6, 0.01), indexing="ij"), -1)
    state = cloud(scene, count=400)
    edge = torch.where(torch.rand(400, generator=torch.Generator().manual_seed(2)) < 0.5, 0.1, 0.38)
    position = torch.stack([edge, torch.linspace(0.42, 0.58, 400)], dim=-1).unsqueeze(0)
    state = with_obstacle(state.with_motion(position, state.velocity), wall.reshape(-1, 2))
    starts = member_starts(emulator_of(scene, 32), state, members=3, nudge=1.0)
    assert bool((starts.position >= 0.1).all())
    inner = ((starts.position > 0.41) & (starts.position < 0.59)).all(-1)
    assert not bool(inner.any())
    moved = (starts.position != state.position).any(-1)
    assert 0.3 < float(moved.float().mean()) < 0.9


def test_nudged_particles_cross_periodic_axes():
    scene = box(**CHANNEL)
    state = cloud(scene)
    state = state.with_motion(state.position * torch.tensor([0.0, 1.0]) + torch.tensor([0.1, 0.0]), state.velocity)
    emulator = emulator_of(scene)
    starts = member_starts(emulator, state, members=2)
    assert bool((starts.position[..., 0] < 0.1).any())
    assert bool((starts.position != state.position).all())
    frames = predict_rollout(emulator, state, 3, RolloutOptions(members=2)).position
    assert float((frames[:, 0, 0] - starts.position).abs().max()) < 0.1


def test_prescribed_and_fields_are_the_same_for_all_members():
    scene = box(obstacles=True, moving_obstacles=True, evolving=("heat",), gravity=None)
    state = with_obstacle(cloud(scene, batch=2), torch.tensor([[0.2, 0.2], [0.22, 0.2]]))
    state = dataclasses.replace(state, fields={"heat": torch.linspace(0, 1, 30).expand(2, -1).clone()})
    moving = torch.linspace(0, 0.1, 12)[:, None, None] + torch.tensor([[0.2, 0.2], [0.22, 0.2]])
    emulator = emulator_of(scene)
    for given in (Prescribed.obstacles(moving), Prescribed.obstacles(moving.expand(2, -1, -1, -1))):
        some = predict_rollout(emulator, state, 10, RolloutOptions(members=5, prescribed=given))
        assert some.fields["heat"].shape == (5, 2, 10, 30)
        starts = member_starts(emulator, state, members=5)
        alone = predict_rollout(emulator, starts.scenes([7]), 10, RolloutOptions(Prescribed.obstacles(moving)))
        torch.testing.assert_close(some.position[3, 1], alone.position[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(some.fields["heat"][3, 1], alone.fields["heat"][0], rtol=1e-5, atol=1e-6)


def test_a_monitor_watches_all_members():
    emulator = emulator_of(box(), scale=3.0)
    monitor = Monitor(Policy.RECORD, speed=0.01)
    predict_rollout(emulator, cloud(box()), 9, RolloutOptions(members=MOST_SCENES + 3, monitor=monitor))
    assert monitor.report().startswith("9 frames")
    assert monitor.incidents[0].what == "speed"
    assert monitor.peaks["speed"] > 0.01
    fast = cloud(box(), batch=MOST_SCENES + 3, speed=0)
    fast.velocity[-1] = 0.05
    monitor = Monitor(Policy.RECORD, speed=0.5)
    predict_rollout(emulator_of(box(), scale=0.0), fast, 4, RolloutOptions(members=1, monitor=monitor))
    assert {incident.scene for incident in monitor.incidents if incident.what == "speed"} == {MOST_SCENES + 2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"members": 0}, "members = 0"), ({"seed": -1}, "seed = -1"), ({"nudge": -0.1}, "nudge = -0.1")],
)
def test_wrong_numbers_are_named(wrong, message):
    with pytest.raises(ConfigError, match=message):
        predict_rollout(emulator_of(box()), cloud(box()), 2, RolloutOptions(**{"members": 2, **wrong}))
