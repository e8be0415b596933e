"""The simulator that is set beside a model: its preset, and what it starts from."""

import dataclasses

import numpy as np
import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.play.beside import fitting_preset, initial_state
from nmpm.sim import load_preset
from nmpm.zoo import Pretrained
from tests.scenes import emulator_of

GOOP = load_preset("goop")
RAMPS = load_preset("waterramps")


def model_of(preset, **changes):
    """A model of made-up weights for a preset's scenes."""
    return Pretrained(emulator_of(dataclasses.replace(preset.scene, **changes), cells=64), {})


def start_of(model, preset, seed=0, count=300):
    drawn = preset.draw(seed)
    ramps = [ramp.particles(preset.spacing) for ramp in drawn.obstacles]
    obstacle = np.concatenate(ramps).astype(np.float32) if ramps else None
    return model.state(drawn.position[:count], drawn.velocity[:count], obstacle=obstacle)


def simulate(scene, state, preset, frames):
    """(frames, N, D) positions of the state's only scene, in its own order."""
    start, order = initial_state(scene, state, preset)
    made = np.empty((frames, len(order), scene.dim))
    made[:, order] = preset.simulate_from(start, frames).position[1:, : len(order)]  # obstacles are behind
    return torch.from_numpy(made)


def test_what_flies_goes_on_flying_with_its_momentum():
    model = model_of(GOOP)
    state = start_of(model, GOOP)
    middle = state.with_motion(state.position - state.position.mean(1, True) + 0.5, 0 * state.velocity + 0.002)
    path = simulate(model.scene, middle, GOOP, 10).mean(1)
    times = torch.arange(1, 11).unsqueeze(1)
    expected = 0.5 + 0.002 * times + middle.gravity * times * times / 2
    torch.testing.assert_close(path.float(), expected, rtol=0, atol=2e-4)


def test_ramps_are_fitted_to_their_particles():
    model = model_of(RAMPS)
    state = start_of(model, RAMPS, seed=2)
    obstacles = fitting_preset(model.scene, state, RAMPS).obstacles_from(state.obstacle[0].double().numpy())
    end = simulate(model.scene, state, RAMPS, 30)[-1].numpy()
    assert min(ramp.distance(end).min() for ramp in obstacles) > 0
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
def test_other_scenes_are_refused_before_any_work(changes, named):
    scene = dataclasses.replace(GOOP.scene, **changes)
    with pytest.raises(ConfigError, match=named):
        fitting_preset(scene, start_of(model_of(GOOP), GOOP), GOOP)


def test_what_a_simulator_cannot_take_is_refused():
    state = start_of(model_of(GOOP), GOOP)
    with pytest.raises(ConfigError, match="all of one size"):
        fitting_preset(GOOP.scene, dataclasses.replace(state, volume=2.0 * state.mask), GOOP)
    with pytest.raises(ConfigError, match="only states that it has drawn"):
        fitting_preset(load_preset("universal").scene, state, load_preset("universal"))
    with pytest.raises(ConfigError, match="no bar of the thickness"):
        RAMPS.obstacles_from(np.random.default_rng(0).uniform(0.4, 0.5, (50, 2)))
    with pytest.raises(ConfigError, match="cannot tell obstacles from their 50 particles"):
        GOOP.obstacles_from(np.random.default_rng(0).uniform(0.4, 0.5, (50, 2)))
