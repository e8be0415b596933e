"""Predictions of a dataset's frames by models of other frames and materials."""

import dataclasses

import pytest
import torch

from nmpm.decoders import Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.evaluation.comparison import free_fall
from nmpm.evaluation.matched import MatchedPredictor
from nmpm.evaluation.trade.sweep import fit_to_scenes
from nmpm.particles import Window
from nmpm.processors import Identity
from nmpm.scene import Reading, Scene
from tests.evaluation.trade.made_up import tiny_emulator, tiny_scenes

DATA = Scene(
    bounds=((0.0, 100.0),) * 2,
    domain=((-10.0, 110.0),) * 2,
    dt=2.0,
    materials=("steel", "glass"),
    particle_volume=4.0,
    gravity=(0.0, -0.05),
)


def predictor_of(every: int, between: int, **changes) -> MatchedPredictor:
    """By an emulator of free fall alone: its network adds nothing."""
    scene = dataclasses.replace(DATA, dt=DATA.dt * every / between, materials=("sand", "goop"), **changes)
    free = Constraints(solids=False)
    recipe = EmulatorRecipe(scene, cells=12, frames=3, processor=Identity(), decoder=Residual(), constraints=free)
    emulator = recipe.build().eval()
    emulator.output_scale.zero_()
    return MatchedPredictor(emulator, Reading(scene, {"steel": "goop", "glass": "sand"}, every, between), DATA)


def thrown(frames: int, gravity=DATA.gravity) -> Window:
    """Two lonely particles that fly freely, at the data's frames."""
    pull = torch.tensor(gravity) * DATA.dt**2
    count = torch.arange(-1.0, frames - 1).view(1, -1, 1, 1)
    start, velocity = torch.tensor([[[30.0, 70.0], [70.0, 60.0]]]), torch.tensor([[[0.8, 0.5], [-0.7, -0.3]]])
    path = start.unsqueeze(1) + velocity.unsqueeze(1) * count + pull * count * (count + 1) / 2
    return Window(
        frames=path,
        material=torch.tensor([[0, 1]]),
        mask=torch.ones(1, 2, dtype=torch.bool),
        obstacle=torch.zeros(1, 0, 2),
        obstacle_mask=torch.zeros(1, 0, dtype=torch.bool),
        gravity=pull[None],
    )


def test_a_model_of_more_materials_predicts_scenes_of_one_as_that_one(tmp_path):
    """The index of a material among the model's is not that among the data's."""
    scenes = tiny_scenes(tmp_path)
    wide = dataclasses.replace(scenes.scene, materials=("water", "goop"))
    fitted = fit_to_scenes("wide", tiny_emulator(wide), scenes)
    window = scenes.window([0])
    state = MatchedPredictor(fitted.emulator, fitted.reading, scenes.scene).state(window.initial)
    assert window.material.unique().tolist() == [0]
    assert state.material.unique().tolist() == [1]
    torch.testing.assert_close(state.velocity, window.initial.velocity)


@pytest.mark.parametrize(("every", "between"), [(1, 1), (1, 2), (1, 5), (2, 1), (3, 1)])
def test_free_flight_is_exact_at_the_frames_that_the_model_reaches(every, between):
    window = thrown(12)
    predicted = predictor_of(every, between).predict(window)
    assert predicted.shape == window.target.shape
    reached = slice(every - 1, None, every)
    torch.testing.assert_close(predicted[:, reached], window.target[:, reached], rtol=0, atol=2e-3)
    largest = DATA.dt**2 * 0.05 * every**2 / 8  # of linear interpolation between
    torch.testing.assert_close(predicted, window.target, rtol=0, atol=largest + 2e-3)
    torch.testing.assert_close(
        predicted[:, reached], free_fall(DATA, window.initial, 10)[:, reached], rtol=0, atol=2e-3
    )


def test_the_state_has_the_model_s_materials_and_gravity_per_frame_of_the_model():
    window, predictor = thrown(4), predictor_of(1, 4)
    state = predictor.state(window.initial)
    assert state.material.tolist() == [[1, 0]]
    torch.testing.assert_close(state.gravity, window.gravity / 16)
    resting = dataclasses.replace(window, frames=window.frames[:, 1:2].expand(-1, 4, -1, -1))
    assert bool((predictor.state(resting.initial).velocity == 0).all())


def test_particles_enter_at_the_data_s_frames():
    window = thrown(12, gravity=(0.0, 0.0))
    present = torch.ones(1, 12, 2, dtype=torch.bool)
    present[:, :6, 1] = False
    window = dataclasses.replace(window, present=present)
    predictor = predictor_of(1, 3, gravity=(0.0, 0.0))
    predicted = predictor.predict(window)
    assert predictor.bundle == 1
    torch.testing.assert_close(predicted[:, :, 0], window.target[:, :, 0])
    torch.testing.assert_close(predicted[:, 6:, 1], window.target[:, 6:, 1])


def test_obstacles_move_at_the_model_s_frames():
    window = thrown(8)
    moved = (torch.arange(8.0) - 1).view(1, -1, 1, 1) * torch.tensor([1.0, 0.0]) + 50.0
    scene = {"obstacles": True, "moving_obstacles": True}
    window = dataclasses.replace(
        window, obstacle=moved[:, 1], obstacle_mask=torch.ones(1, 1, dtype=torch.bool), obstacle_frames=moved
    )
    for every, between in ((1, 2), (2, 1)):
        path = predictor_of(every, between, **scene)._obstacle_path(moved[:, 1:])
        assert path[0, 1, 0].tolist() == [50.0 + every / between, 50.0]
        assert predictor_of(every, between, **scene).predict(window).shape == window.target.shape


def test_gravity_that_the_dataset_does_not_state_is_the_readings():
    window = thrown(12)
    predictor = predictor_of(1, 2)
    unstated = dataclasses.replace(predictor, scene=dataclasses.replace(DATA, gravity=None))
    silent = dataclasses.replace(window, gravity=torch.zeros_like(window.gravity))
    torch.testing.assert_close(unstated.predict(silent), predictor.predict(window), rtol=0, atol=1e-5)
