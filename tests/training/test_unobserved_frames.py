"""Trainings and evaluations in a model's frames, of which the data have only some, or which skip some of theirs."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import write_metadata, write_split
from nmpm.data.sources import FolderSource
from nmpm.emulator import Rollout
from nmpm.emulator.calibration import calibrate
from nmpm.evaluation.comparison import Comparison, free_fall
from nmpm.evaluation.prediction_errors import Measures, measure_errors
from nmpm.metrics import MSE, EarthMover
from nmpm.particles import Window
from nmpm.scene import Reading
from nmpm.training.losses import PositionLoss, counted
from tests.made_up import made_up_metadata, made_up_trajectory
from tests.scenes import box, cloud, emulator_of
from tests.trainings import data_of, module_of, trainer_of


@pytest.fixture
def folder(tmp_path):
    for seed, name in enumerate(("train", "valid", "test")):
        write_split(
            tmp_path / "data" / f"{name}.h5", [made_up_trajectory(17, 8, 2 * seed + i, statics=1) for i in (0, 1)]
        )
    write_metadata(tmp_path / "data", made_up_metadata())
    return tmp_path / "data"


def read_with(folder: Path, every: int = 1, between: int = 1, **options) -> TrajectoryDataModule:
    data = data_of(folder, **options)
    scene = FolderSource(folder).scene
    data.reading = Reading(dataclasses.replace(scene, dt=scene.dt * every / between), {}, every, between)
    return data


def observed_every(window: Window, between: int) -> Window:
    observed = torch.zeros(window.frames.shape[:2], dtype=torch.bool)
    observed[:, 1::between] = True
    return dataclasses.replace(window, observed=observed)


def falling(frames: int, between: int) -> tuple[Window, torch.Tensor]:
    """A free fall of which every so-maniest frame was observed, and its exact prediction."""
    scene = box(evolving=("heat",))
    state = dataclasses.replace(cloud(scene, 6, batch=2), fields={"heat": torch.ones(2, 6)})
    path = free_fall(scene, state, frames)
    start = torch.stack([state.position - state.velocity, state.position], dim=1)
    fields = {"heat": torch.ones(2, frames + 2, 6)}
    window = dataclasses.replace(Window.of(state), frames=torch.cat([start, path], dim=1), fields=fields)
    return observed_every(window, between), path


@pytest.mark.parametrize("between", [2, 4])
def test_only_errors_at_observed_frames_are_reported(between):
    window, exact = falling(20, between)
    scene, hidden = box(evolving=("heat",)), ~window.observed[0, 2:]
    wrong, heat = exact.clone(), torch.ones(2, 20, 6)
    wrong[:, hidden] += 0.1
    heat[:, hidden] += 5
    comparison = Comparison(scene, [MSE((1, 2, 10)), EarthMover(every=2)])
    comparison.update(window, wrong, {"heat": heat})
    errors = comparison.compute()
    assert {"mse", "mse@1", "mse@2", "emd", "mse_heat", "free_fall/mse"} <= errors.keys()
    assert ("mse@10" in errors) == (between == 2)  # frames of the data
    assert all(value < 1e-12 for name, value in errors.items() if not name.startswith("still"))
    assert errors["still/mse"] > 1e-7
    measured = measure_errors(scene, window.scenes([0]), wrong[:1], Measures((2,)))
    assert measured["mse@2"] == measured["mse"] == measured["emd"] == 0
    assert measured["kinetic"] == 0


def test_horizons_count_the_frames_of_the_data_that_a_model_skips():
    window, exact = falling(12, 1)
    plain, skipping = (Comparison(box(), [MSE((1, 3, 4, 12, 30))]) for _ in range(2))
    skipping.count_every(3)
    for comparison in (plain, skipping):
        comparison.update(window, exact + torch.arange(12).view(1, 12, 1, 1))
    one, other = plain.errors["model"].compute(), skipping.errors["model"].compute()
    assert list(one) == ["mse@1", "mse@3", "mse@4", "mse@12", "mse"]
    assert list(other) == ["mse@3", "mse@4", "mse@12", "mse@30", "mse"]
    assert one["mse@4"] == other["mse@12"]
    assert other["mse@3"] == other["mse@4"] == one["mse@1"]


@pytest.mark.parametrize(("power", "weight", "between"), [(1.0, 0.0, 2), (0.5, 4.0, 3), (0.5, 4.0, 8)])
def test_errors_and_their_gradients_do_not_depend_on_frames_that_nobody_observed(power, weight, between):
    window, exact = falling(16, between)
    emulator, loss = emulator_of(box(), 42), PositionLoss(power, weight)
    other = window.frames.clone()
    other[:, 2:][:, ~window.observed[0, 2:]] = 0.5
    predicted = (exact + 0.01 * torch.randn(exact.shape)).requires_grad_()
    losses = [
        loss(Rollout(predicted, {}), dataclasses.replace(window, frames=frames), emulator)
        for frames in (window.frames, other)
    ]
    slopes = [torch.autograd.grad(loss, predicted)[0] for loss in losses]
    assert torch.equal(*losses)
    assert torch.equal(*slopes)
    assert torch.equal(slopes[0].abs().sum((0, 2, 3)) > 0, window.observed[0, 2:])
    wrong = torch.where(window.observed[:, 2:, None, None], exact, 0.5)
    heat = torch.where(window.observed[:, 2:, None], 1.0, 7.0).expand(2, 16, 6)
    warm = emulator_of(box(evolving=("heat",)), 42)
    perfect = PositionLoss(1.0, weight)(Rollout(wrong, {"heat": heat}), window, warm)
    assert perfect == 0  # also in bundles without an observed frame


def test_frames_that_were_all_observed_have_the_errors_of_plain_ones():
    window, exact = falling(8, 1)
    predicted, emulator = Rollout(exact + 0.01 * torch.randn(exact.shape), {}), emulator_of(box(), 42)
    plain = dataclasses.replace(window, observed=None)
    for loss in (PositionLoss(1.0, 0.0), PositionLoss()):
        one, other = (loss(predicted, each, emulator) for each in (window, plain))
        torch.testing.assert_close(one, other)
    unseen = dataclasses.replace(window, observed=window.observed & False)
    assert PositionLoss()(predicted, unseen, emulator) == 0
    assert counted(unseen, 8, 4).sum() == 0


@pytest.mark.parametrize("between", [2, 3])
def test_a_training_step_does_not_depend_on_frames_that_nobody_observed(folder, between):
    data = read_with(folder, between=between)
    window = next(iter(data.train_dataloader()))
    module = module_of(data, position_noise=0.0, grid_noise=0.0)
    calibrate(module.emulator, [window])
    module.log = lambda *_: None
    other = window.frames.clone()
    other[:, 2:][:, ~window.observed[0, 2:]] = 0.5
    results = []
    for frames in (window.frames, other):
        loss = module.training_step(dataclasses.replace(window, frames=frames), 0)
        gradients = torch.autograd.grad(loss, [w for w in module.parameters() if w.requires_grad])
        results.append(torch.cat([loss.detach().view(1), *(gradient.flatten() for gradient in gradients)]))
    assert torch.equal(*results)
    assert results[0].isfinite().all()
    assert results[0].any()
    module.unroll_growth, module.reading = 1.0, data.reading
    assert module.bundles(0.0) == between - 1  # of 2 frames, one of them observed


def test_calibration_on_a_free_fall_finds_nothing_to_learn_between_the_frames(folder):
    data = read_with(folder, between=4)
    window, _ = falling(18, 4)
    plain = dataclasses.replace(window, observed=None)
    emulators = [module_of(data).emulator for _ in range(2)]
    for emulator, each in zip(emulators, (window, plain), strict=True):
        calibrate(emulator, [dataclasses.replace(each, fields={})])
    for name, value in emulators[0].state_dict().items():
        assert torch.equal(value, emulators[1].state_dict()[name]), name


@pytest.mark.parametrize("stride", [{"every": 2}, {"between": 2}])
def test_a_resumed_training_ends_with_the_same_weights(folder, tmp_path, stride):
    def made():
        data = read_with(folder, **stride)
        return module_of(data), data

    whole, resumed = made(), made()
    trainer_of(tmp_path / "whole", 4).fit(*whole)
    trainer_of(tmp_path / "parts", 2).fit(*made())
    trainer = trainer_of(tmp_path / "parts", 4)
    trainer.fit(*resumed, ckpt_path=tmp_path / "parts" / "last.ckpt", weights_only=True)
    for name, value in whole[0].state_dict().items():
        assert torch.equal(value, resumed[0].state_dict()[name]), name
    tested = trainer.test(resumed[0], resumed[1], verbose=False)[0]
    assert np.isfinite(list(tested.values())).all()
    assert ("test/mse@1" in tested) == ("between" in stride)  # a frame of the data
    assert "test/mse@4" in tested
