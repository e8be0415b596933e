import warnings

import pytest
import torch

from nmpm import Zoo
from nmpm.emulator import RolloutOptions, stream_rollout
from nmpm.emulator.monitor import Monitor, Policy, RolloutStoppedError
from nmpm.emulator.rollouts import rollout
from nmpm.particles import lattice, state_at_rest
from tests.scenes import box, cloud, emulator_of


def test_stop_hands_out_what_was_sound_and_names_the_incident():
    emulator, particles = emulator_of(box(), scale=1e-6), cloud(box(), speed=0.0)
    monitor, handed = Monitor(Policy.STOP, speed=0.05), []  # of falling: reached after about 13 frames
    with pytest.raises(
        RolloutStoppedError, match=r"stopped: speed 0\.\d+ cells per frame \(limit 0.05\) in scene 0 by frame 4"
    ):
        handed.extend(stream_rollout(emulator, particles, 100, RolloutOptions(monitor=monitor)))
    assert 1 < len(handed) < 25
    assert [incident.what for incident in monitor.incidents] == ["speed"]


def test_warn_speaks_once_for_each_kind():
    monitor = Monitor(Policy.WARN, speed=0.1)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        rollout(emulator_of(box(), scale=5.0), cloud(box()), 40, RolloutOptions(monitor=monitor))
    kinds = [incident.what for incident in monitor.incidents]
    assert sorted(set(kinds)) == sorted(kinds)
    assert {"speed", "energy"} <= set(kinds)
    assert len(heard) == len(kinds)


def test_a_shipped_model_of_sph_keeps_the_limits_on_its_own_scene():
    model, monitor = Zoo.load("dambreak2d"), Monitor(Policy.STOP)
    for _ in stream_rollout(model.emulator, model.example(seed=1), 136, RolloutOptions(monitor=monitor)):
        pass
    shown = model.emulator.input_high[model.scene.input_channels.index("water.volume")]
    assert 3 > monitor.peaks["crowding"] > float(shown)  # of the network's range, widened
    assert not monitor.incidents
    assert "energy never above the start's" in monitor.report()


def test_crowding_is_the_fullest_cell():
    scene = box(particle_volume=0.01**2)
    state = state_at_rest(scene, lattice(((0.3, 0.6), (0.3, 0.6)), 0.01))
    packed = state.with_motion(0.45 + 0.5 * (state.position - 0.45), state.velocity)
    for start, expected in ((state, 1.0), (packed, 4.0)):
        monitor = Monitor(Policy.RECORD, crowding=2.0)
        rollout(emulator_of(scene, scale=1e-6), start, 4, RolloutOptions(monitor=monitor))
        assert monitor.peaks["crowding"] == pytest.approx(expected, rel=0.2)
        assert bool(monitor.incidents) == (expected > 2)


def test_measures_that_stay_on_the_device_for_16_bundles_say_the_same(monkeypatch):
    emulator, particles, monitors = emulator_of(box(), scale=5.0), cloud(box(), batch=2), []
    for on_cpu in (True, False):
        monkeypatch.setattr("nmpm.emulator.monitor.is_eager_cpu", lambda values, on_cpu=on_cpu: on_cpu)
        monitors.append(Monitor(Policy.RECORD, speed=0.1))
        rollout(emulator, particles, 4 * 37, RolloutOptions(monitor=monitors[-1]))
    early, late = monitors
    assert late.incidents == early.incidents
    assert late.peaks == early.peaks
    assert late.report() == early.report()
    assert late.incidents[0].frame < 4 * 16


def test_what_is_no_number_is_an_incident_by_name():
    emulator, monitor = emulator_of(box()).requires_grad_(False), Monitor(Policy.RECORD)
    emulator.processor.register_forward_hook(lambda _, __, output: output * torch.nan)
    rollout(emulator, cloud(box()), 4, RolloutOptions(monitor=monitor))
    assert monitor.incidents[0].what == "not finite"
