import dataclasses

import numpy as np
import pytest
import torch

from nmpm import Zoo
from nmpm.errors import DataError
from nmpm.sim import load_preset
from nmpm.zoo.scenes import simulate_scene, training_preset


@pytest.mark.parametrize("name", ["waterramps", "variablegravity"])
def test_an_example_is_the_scene_that_the_preset_draws(name):
    """With its obstacles and as many particles, one simulated frame later, the same for the same seed."""
    model, preset = Zoo.load(name), load_preset(name)
    state, again = model.example(seed=3), model.example(seed=3)
    frames = preset.simulate_from(preset.draw(3), 1).position
    count = state.position.shape[1]
    torch.testing.assert_close(state.position[0].numpy(), frames[1, :count])
    np.testing.assert_allclose(state.velocity[0], frames[1, :count] - frames[0, :count], atol=1e-6)
    np.testing.assert_allclose(state.obstacle[0], frames[0, count:])
    assert count == len(preset.draw(3).position)
    torch.testing.assert_close(state.position, again.position, rtol=0, atol=0)
    assert not torch.equal(state.position[:, :100], model.example(seed=4).position[:, :100])


def test_gravity_of_an_example_is_drawn_or_stated():
    model, dt = Zoo.load("variablegravity"), load_preset("variablegravity").frame_dt
    drawn, stated = model.example(seed=1), model.example(seed=1, gravity=(6.0, -7.5))
    assert abs(float(drawn.gravity[0, 0])) > 0
    np.testing.assert_allclose(stated.gravity[0] / dt**2, [6.0, -7.5], rtol=1e-5)
    np.testing.assert_allclose(stated.position[0], drawn.position[0], atol=0.01)
    with pytest.raises(DataError, match="outside of the range"):
        model.example(gravity=(0.0, -90.0))
    with pytest.raises(DataError, match="knows only"):
        Zoo.load("waterramps").example(gravity=(0.0, -5.0))


def test_models_of_other_scenes_than_a_preset_get_thrown_blocks():
    goop = Zoo.load("goop")
    assert training_preset(goop.scene, goop.preset).name == "goop"
    recorded = dataclasses.replace(goop, card=goop.card | {"dataset": "deepmind-goop"})
    wide = goop.over(dataclasses.replace(goop.scene, bounds=((0.1, 1.9), (0.1, 0.9)), domain=((0, 2), (0, 1))))
    for model in (recorded, wide):
        assert training_preset(model.scene, model.preset) is None
        thrown = model.example(seed=2)
        torch.testing.assert_close(thrown.position, model.example(seed=2, count=1000).position)
    assert goop.example(blocks=4).position.shape == goop.example(count=1000, blocks=4).position.shape


def test_a_simulated_scene_is_what_the_example_starts():
    trajectory = simulate_scene(load_preset("goop"), 5, 3)
    state = Zoo.load("goop").example(seed=5)
    np.testing.assert_allclose(trajectory.position[1], state.position[0])
    assert trajectory.position.shape[0] == 4
