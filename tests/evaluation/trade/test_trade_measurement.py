"""Measurements over a tiny simulated dataset: errors in closed form, failures, times, and what the store gives back."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import torch

from nmpm.data.windows import Recording
from nmpm.emulator import rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.comparison import free_fall
from nmpm.evaluation.prediction_errors import field_error, measure_errors, recorded_energy_gain
from nmpm.evaluation.trade import Kind, Scenes, Store, measure
from nmpm.evaluation.trade.choices import PredictorChoice, SimulatorChoice
from nmpm.evaluation.trade.measurement import measure_accuracy
from nmpm.evaluation.trade.report import csv_text
from nmpm.evaluation.trade.sweep import Timing
from nmpm.metrics.quantities import into_domain
from nmpm.sim import load_preset
from nmpm.sim.sph.preset import SphPreset
from nmpm.sim.state import SimulatedTrajectory
from tests.evaluation.trade.made_up import flow, tiny_emulator, tiny_sweep


def named(choices, name):
    return next(choice for choice in choices if choice.name == name)


def run(choices, scenes, folder):
    return measure(choices, scenes, tiny_sweep(), Store(folder))


def made(name, scenes, make):
    """A choice that predicts what a function makes of the recorded frames."""

    def predict(state, frames):
        index = next(i for i in range(len(scenes)) if torch.equal(scenes.window([i]).initial.position, state.position))
        return make(scenes.window([index], frames).target)

    return PredictorChoice(kind=Kind.OTHER, name=name, predictor=predict)


def ignore(*_):
    """No progress."""


def test_measuring_again_measures_nothing_and_gives_the_same_points(scenes, choices, tmp_path, monkeypatch):
    first = run(choices, scenes, tmp_path)
    for choice in choices:
        monkeypatch.setattr(type(choice), "prepare", lambda *_: pytest.fail("measured again"))
    assert csv_text(run(choices, scenes, tmp_path), scenes) == csv_text(first, scenes)


def test_an_interrupted_measurement_goes_on_to_the_same_errors(scenes, choices, tmp_path):
    measures, choice = tiny_sweep().measures, named(choices, "carried")
    whole = measure_accuracy(choice, scenes, measures, Store(tmp_path / "whole"), ignore)
    cut = Store(tmp_path / "cut")

    def kill(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # after the first scene
        measure_accuracy(choice, scenes, measures, cut, kill)
    (path,) = (tmp_path / "cut" / "points").iterdir()
    assert len(json.loads(path.read_text())["values"]) == 1
    resumed = measure_accuracy(choice, scenes, measures, cut, ignore)
    assert [row | {"seconds": None} for row in resumed] == [row | {"seconds": None} for row in whole]


def test_digests_tell_facts_of_the_scene_and_fields_apart():
    scenes = flow(0.1, [0.01] * 8)
    changes = ({"bounds": ((0.0, 1.0), (0.05, 1.0))}, {"particle_volume": 2e-3}, {"dt": 0.02}, {})
    others = [dataclasses.replace(scenes, scene=dataclasses.replace(scenes.scene, **facts)) for facts in changes]
    for fields in ({"heat": torch.zeros(9, 100)}, {"heat": torch.ones(9, 100)}, {"salt": torch.ones(9, 100)}):
        recording = dataclasses.replace(scenes.recordings[0], fields=fields)
        others.append(dataclasses.replace(scenes, recordings=(recording,)))
    assert len({other.digests for other in others}) == len(others)


def test_errors_curves_and_frames_are_those_of_the_predictions(scenes, choices, tmp_path):
    points = {point.name: point for point in run(choices, scenes, tmp_path)}
    window = scenes.window([1])
    predicted = rollout(tiny_emulator(scenes.scene), window.initial, scenes.frames(1))
    expected = (predicted - window.target).double().square().mean((0, 2, 3)).numpy()
    np.testing.assert_allclose(points["carried"].curves[1], expected, rtol=1e-4)
    assert points["carried"].errors["mse"][1] == pytest.approx(expected.mean(), rel=1e-4)
    assert points["carried"].errors["mse@4"][1] == pytest.approx(expected[:4].mean(), rel=1e-4)
    still, shipped = points["nothing moves"], points[choices[0].name]
    np.testing.assert_allclose(still.frames[0], scenes.recordings[0].frames[1].numpy(), rtol=1e-6)
    np.testing.assert_allclose(shipped.frames[-1], scenes.recordings[0].frames[-1].numpy(), rtol=1e-6)
    assert shipped.exact
    assert not shipped.errors["emd"].any()


def fail(_):
    raise ConfigError("the simulation has blown up in frame 3")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (fail, "the simulation has blown up in frame 3"),
        (lambda target: target / (torch.arange(target.shape[1]) != 2).view(1, -1, 1, 1), "from predicted frame 3 on"),
        (lambda target: target + 0.1 * torch.arange(target.shape[1]).view(1, -1, 1, 1), "of energy"),
        (lambda target: target[:, :, 1:], "bad returns (1,"),
    ],
    ids=["raises", "not finite", "gains energy", "wrong shape"],
)
def test_what_fails_is_named_and_does_not_compete(scenes, tmp_path, make, reason):
    (point,) = run([made("bad", scenes, make)], scenes, tmp_path)
    assert not point.competes
    assert set(point.failures) == {0, 1}
    assert all(reason in text for text in point.failures.values())


def test_what_the_machine_cannot_do_is_raised_and_tried_again(scenes, tmp_path):
    def exhaust(_):
        raise ConfigError("the network cannot be compiled") from MemoryError()

    with pytest.raises(ConfigError, match="cannot be compiled"):
        run([made("machine", scenes, exhaust)], scenes, tmp_path)
    (point,) = run([made("machine", scenes, lambda target: target)], scenes, tmp_path)
    assert point.competes


def test_errors_of_a_shift_are_in_closed_form(scenes, tmp_path):
    (point,) = run([made("shifted", scenes, lambda target: target + torch.tensor([0.01, 0.0]))], scenes, tmp_path)
    np.testing.assert_allclose(point.errors["mse"], 0.01**2 / 2, rtol=1e-3)  # the mean over two axes
    np.testing.assert_allclose(point.errors["emd"], 0.01, rtol=1e-3)
    np.testing.assert_allclose(point.errors["height"], 0, atol=1e-6)


def test_free_fall_conserves_energy_and_repeats_free_fall(scenes):
    window = scenes.window([0])
    falling = free_fall(scenes.scene, window.initial, 6)
    fallen = dataclasses.replace(window, frames=torch.cat([window.frames[:, :2], falling], 1))
    assert not any(measure_errors(scenes.scene, fallen, falling, tiny_sweep().measures).values())
    assert not bool((falling[..., 1] <= scenes.scene.bounds[1][0]).any())
    assert abs(recorded_energy_gain(scenes.scene, fallen, falling)) < 1e-3


def test_the_field_error_asks_where_material_is_and_not_which_particle(scenes):
    target = scenes.window([0]).target[0].double()
    material = scenes.recordings[0].material
    shuffled = target[:, torch.randperm(target.shape[1], generator=torch.Generator().manual_seed(0))]
    assert field_error(scenes.scene, shuffled, target, material) < 1e-12
    left, right = (torch.full_like(target, place) for place in (0.2, 0.8))
    assert field_error(scenes.scene, left, right, material) == 1


def test_errors_of_fields_and_shapes_do_not_depend_on_whole_periods():
    scenes = flow(0.7, [0.02] * 30)  # across the border
    window, measures = scenes.window([0]), tiny_sweep().measures
    slower = flow(0.7, [0.02] + [0.015] * 29).window([0]).target
    errors = measure_errors(scenes.scene, window, slower, measures)
    turned = measure_errors(scenes.scene, window, slower + torch.tensor([-2.0, 0.0]), measures)
    assert 0.1 < errors["field"] < 0.9
    for name in ("field", "crowding", "height"):
        np.testing.assert_allclose(turned[name], errors[name], rtol=1e-3, atol=1e-6)
    inside = into_domain(scenes.scene, torch.tensor([[1.25, 0.5], [-2.25, 1.5], [0.5, -0.5]]))
    torch.testing.assert_close(inside, torch.tensor([[0.25, 0.5], [0.75, 1.0], [0.5, 0.0]]))


def test_resting_frames_are_not_timed_and_rest_is_found_across_a_periodic_border(scenes):
    frames = scenes.recordings[0].frames
    stopped = torch.cat([frames[:6], frames[5:6].expand(20, -1, -1)])
    rest = dataclasses.replace(scenes, recordings=(dataclasses.replace(scenes.recordings[0], frames=stopped),))
    assert (rest.moving_frames(0), rest.frames(0)) == (4, 24)  # frames 2 to 5, as predictions start at frame 2
    slowing = 0.02 * 0.8 ** np.arange(40)
    assert flow(0.9, slowing).moving_frames(0) == flow(0.1, slowing).moving_frames(0) < 30


def test_times_are_per_frame_that_is_computed(scenes, choices, monkeypatch, tmp_path):
    timed = [choices[0], named(choices, "carried"), named(choices, "carried, batch 2"), named(choices, "free fall")]
    ticks = itertools.count()  # each rollout takes a second
    monkeypatch.setattr("nmpm.evaluation.trade.measurement.clock_for", lambda *_: ("a clock", lambda: next(ticks)))
    sweep = dataclasses.replace(tiny_sweep(), timing=Timing(rounds=1, frames=3))
    points = measure(timed, scenes, sweep, Store(tmp_path))
    frames = [1e3 / point.milliseconds for point in points]
    assert frames == pytest.approx([4, 4, 8, 3])  # one more; a bundle of 2 more, of one and of two scenes; as asked


def drops(preset, start):
    """One test scene of SPH water, whose recorded particles (N, D) rest for 16 frames."""
    frames = torch.from_numpy(start).float().expand(16, *start.shape)
    material, gravity = torch.zeros(len(start), dtype=torch.long), torch.tensor([0.0, -9.81 * preset.scene.dt**2])
    recording = Recording(frames, material, torch.zeros(0, 2), gravity)
    return Scenes("drops", preset.scene, (recording,), preset, (3,))


def simulate_as(path, monkeypatch):
    """Let SPH presets simulate `path`, from the initial positions (M, D) and a number of frames."""

    def simulate_from(self, start, frames, progress=None):
        position = path(start.position, frames).astype(np.float32)
        return SimulatedTrajectory(position, np.full(position.shape[1], 5), {})

    monkeypatch.setattr(SphPreset, "simulate_from", simulate_from)


def rise_and_fall(start, frames):
    """The particle nearest to the floor rises like all others fall: the energy stays, unless it counts more often."""
    rise = 5e-4 * np.arange(frames + 1) ** 2
    path = np.repeat(start[None], frames + 1, axis=0)
    path[..., 1] -= rise[:, None] / (len(start) - 1)
    path[:, np.argmin(start[:, 1]), 1] = start[:, 1].min() + rise
    return path


def test_a_simulation_of_larger_particles_is_judged_by_their_own_energy(tmp_path, monkeypatch):
    preset = load_preset("wbcsph").coarsened(4)
    coarser = SimulatorChoice(name="coarser", preset=preset.coarsened(2))
    first, start = preset.draw(3).position, coarser.preset.draw(3).position
    crowded = first.copy()
    crowded[: len(first) // 2] = start[np.argmin(start[:, 1])]  # half of them follow the one that rises
    scenes = drops(preset, crowded)
    simulate_as(rise_and_fall, monkeypatch)
    position, gain = coarser.predict(scenes, 0)
    assert recorded_energy_gain(scenes.scene, scenes.window([0]), position) > 0.05 > abs(gain)
    (point,) = run([coarser], scenes, tmp_path / "stable")
    assert point.stable
    simulate_as(lambda start, frames: start + 0.002 * np.arange(frames + 1)[:, None, None] ** 2, monkeypatch)
    (point,) = run([coarser], drops(preset, first), tmp_path / "unstable")
    assert "of energy" in point.failures[0]
