"""Rollouts that a simulator continues from the last trusted frame on."""

import dataclasses

import numpy as np
import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.sim import InitialState, load_preset
from nmpm.zoo import Pretrained
from nmpm.zoo.fallback import fitting_preset, simulate_on
from tests.scenes import emulator_of

GOOP = load_preset("goop")
RAMPS = load_preset("waterramps")


def model_of(preset, limit=0.024, **changes):
    """A model of made-up weights for a preset's scenes."""
    scene = dataclasses.replace(preset.scene, **changes)
    card = {"trust": {"limit": limit, "error": 0.2, "scenes": 8}}
    return Pretrained(emulator_of(scene, cells=64, scale=0.3).requires_grad_(False), card)


def start_of(model, preset, seed=0, count=300):
    drawn = preset.draw(seed)
    ramps = [ramp.particles(preset.spacing) for ramp in drawn.obstacles]
    obstacle = np.concatenate(ramps).astype(np.float32) if ramps else None
    return model.state(drawn.position[:count], drawn.velocity[:count], obstacle=obstacle)


@pytest.fixture(scope="module")
def ended():
    """A model, a state, and its rollout that the simulator continues."""
    model = model_of(GOOP)
    state = start_of(model, GOOP)
    return model, state, model.predict(state, 40, fallback="goop")


def test_the_simulator_goes_on_from_the_last_trusted_frame(ended):
    model, state, continued = ended
    (last,) = continued.trusted.tolist()
    assert 1 < last < 40
    trusted = model.rollout(state, 40, until="trusted")
    assert trusted.shape[1] == last
    assert torch.equal(trusted, model.rollout(state, last))
    assert torch.equal(continued.position[:, :last], trusted)
    velocity = (trusted[0, -1] - trusted[0, -2]).double().numpy() / GOOP.frame_dt
    begun = np.clip(trusted[0, -1].double().numpy(), *np.array(GOOP.reach).T)
    made = GOOP.simulate_from(InitialState(begun, velocity), 40 - last)
    torch.testing.assert_close(continued.position[0, last:], torch.from_numpy(made.position[1:]))


def test_what_flies_goes_on_flying_with_its_momentum():
    model = model_of(GOOP)
    state = start_of(model, GOOP).scenes([0])
    middle = state.with_motion(state.position - state.position.mean(1, True) + 0.5, 0 * state.velocity + 0.002)
    path = simulate_on(model.scene, middle, GOOP, 10).mean(1)
    times = torch.arange(1, 11).unsqueeze(1)
    expected = 0.5 + 0.002 * times + middle.gravity * times * times / 2
    torch.testing.assert_close(path, expected, rtol=0, atol=2e-4)


def test_scenes_of_a_batch_go_on_from_frames_of_their_own_among_their_ramps():
    model = model_of(RAMPS)
    states = [start_of(model, RAMPS, seed) for seed in (1, 2)]
    both = model.predict(type(states[0]).stack(states), 30, fallback=RAMPS)
    assert both.position.shape == (2, 30, 300, 2)
    assert both.position.isfinite().all()
    obstacles = fitting_preset(model.scene, states[1], RAMPS).obstacles_from(states[1].obstacle[0].double().numpy())
    assert min(ramp.distance(both.position[1, -1].double().numpy()).min() for ramp in obstacles) > 0
    drawn = RAMPS.draw(2).obstacles
    points = np.random.default_rng(0).uniform(0.1, 0.9, (500, 2))
    for ours, theirs in ((obstacles, drawn), (drawn, obstacles)):
        for ramp in ours:
            assert min(np.abs(ramp.distance(points) - other.distance(points)).max() for other in theirs) < 1e-6


def test_frames_as_long_as_two_of_the_simulators_are_simulated_as_such():
    model = model_of(GOOP, dt=2 * GOOP.frame_dt)
    state = start_of(model, GOOP)
    assert fitting_preset(model.scene, state, GOOP).frame_dt == pytest.approx(model.scene.dt)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"materials": ("mud",)}, "simulates goop, not mud"),
        ({"bounds": ((0.2, 0.8), (0.2, 0.8))}, "its bounds are"),
        ({"particle_volume": 0.02**2}, "have the volume"),
        ({"evolving": ("heat",)}, "it has no heat"),
    ],
)
def test_other_scenes_are_refused_before_any_work(ended, changes, named):
    _, state, _ = ended
    scene = dataclasses.replace(GOOP.scene, **changes)
    with pytest.raises(ConfigError, match=named):
        fitting_preset(scene, state, GOOP)


def test_refusals(ended):
    model, state, _ = ended
    with pytest.raises(ConfigError, match="all of one size"):
        model.rollout(dataclasses.replace(state, volume=2.0 * state.mask), 5, fallback="goop")
    with pytest.raises(ConfigError, match="only states that it has drawn"):
        fitting_preset(load_preset("universal").scene, state, load_preset("universal"))
    with pytest.raises(ConfigError, match="leave members and what is prescribed out"):
        model.rollout(state, 5, members=2, fallback="goop")
    with pytest.raises(ConfigError, match="until = 'lost'"):
        model.rollout(state, 5, until="lost")
    with pytest.raises(ConfigError, match="There is no preset or file gooo"):
        model.rollout(state, 5, fallback="gooo")
    with pytest.raises(ConfigError, match="no bar of the thickness"):
        RAMPS.obstacles_from(np.random.default_rng(0).uniform(0.4, 0.5, (50, 2)))
    with pytest.raises(ConfigError, match="cannot tell obstacles from their 50 particles"):
        GOOP.obstacles_from(np.random.default_rng(0).uniform(0.4, 0.5, (50, 2)))
