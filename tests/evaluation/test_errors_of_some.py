"""Errors of predictions in which particles are absent or of several sizes: those of the particles there, by volume."""

import dataclasses

import pytest
import torch

from nmpm.evaluation.prediction_errors import Measures, measure_errors, recorded_energy_gain
from nmpm.metrics import MSE, EarthMover, FieldMSE
from nmpm.particles import Window
from tests.scenes import box, cloud

SCENE = box()
MEASURES = Measures(horizons=(2,), emd_frames=2)


def window_of_six(frames: int = 6) -> Window:
    state = cloud(SCENE, 6, speed=0.004)
    steps = torch.arange(-1, frames + 1).view(1, -1, 1, 1)
    path = state.position.unsqueeze(1) + steps * state.velocity.unsqueeze(1)
    return dataclasses.replace(Window.of(state), frames=path)


def part(window: Window, chosen: list[int]) -> Window:
    """The window of some of its particles."""
    axes = {"frames": 2, "material": 1, "mask": 1}
    return dataclasses.replace(
        window, **{name: getattr(window, name).index_select(axis, torch.tensor(chosen)) for name, axis in axes.items()}
    )


def test_errors_are_those_of_the_particles_that_are_there():
    window = window_of_six()
    predicted = window.target + 0.01 * torch.randn(window.target.shape, generator=torch.Generator().manual_seed(0))
    few = measure_errors(SCENE, part(window, [0, 1, 2, 3]), predicted[:, :, :4], MEASURES)
    present = torch.ones(window.frames.shape[:3], dtype=torch.bool)
    present[..., 4:] = False
    absent = predicted.clone()
    absent[:, :, 4:] = torch.nan
    errors = measure_errors(SCENE, dataclasses.replace(window, present=present), absent, MEASURES)
    assert errors.keys() == {"mse", "mse@2", "field", "emd"}
    assert errors == pytest.approx({name: few[name] for name in errors})


def test_metrics_of_frames_without_a_particle_leave_them_out_and_broken_predictions_are_not_hidden():
    window = window_of_six()
    window.fields = {"heat": torch.zeros(1, 8, 6)}
    window.present = torch.ones(1, 8, 6, dtype=torch.bool)
    window.present[:, 4:6] = False
    predicted = window.target + 0.1
    metric, fields, emd = MSE((2, 3)), FieldMSE(["heat"]), EarthMover(1)
    metric.update(window, predicted)
    emd.update(window, predicted)
    fields.update(window, {"heat": torch.ones(1, 6, 6)})
    values = metric.compute() | fields.compute()
    assert {name: round(float(value), 4) for name, value in values.items()} == {
        "mse@2": 0.01, "mse@3": 0.01, "mse": 0.01, "mse_heat": 1.0, "still/mse_heat": 0.0,
    }  # fmt: skip
    assert metric.curves()[0].isnan().tolist() == [False] * 2 + [True] * 2 + [False] * 2
    assert float(emd.compute()["emd"]) == pytest.approx(0.1 * 2**0.5, rel=0.3)
    broken = MSE()
    predicted[0, 0, 0] = torch.nan
    broken.update(window, predicted)
    assert broken.compute()["mse"].isnan()


def test_a_particle_of_twice_the_size_counts_in_densities_and_distances_as_two():
    window = window_of_six()
    predicted = window.target + 0.02 * torch.randn(window.target.shape, generator=torch.Generator().manual_seed(1))
    volume = torch.ones(1, 6)
    volume[0, 0] = 2.0
    sized = measure_errors(SCENE, dataclasses.replace(window, volume=volume), predicted, MEASURES)
    order = [0, 0, 1, 2, 3, 4, 5]
    twice = measure_errors(SCENE, part(window, order), predicted[:, :, order], MEASURES)
    for name in ("field", "emd", "kinetic", "height"):
        assert sized[name] == pytest.approx(twice[name]), name


def test_where_energy_comes_in_its_gain_is_no_instability():
    window = window_of_six()
    fast = window.target + torch.linspace(0, 0.5, 6).view(1, -1, 1, 1)
    assert recorded_energy_gain(SCENE, window, fast) > 0.05
    scene = box(obstacles=True, moving_obstacles=True)
    assert recorded_energy_gain(scene, window, fast) == 0
