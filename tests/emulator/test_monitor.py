import warnings

import pytest
import torch
from scenes import box, cloud

from nmpm.data.initial_states import lattice, resting
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.monitor import Monitor, Policy, RolloutStoppedError
from nmpm.emulator.rollouts import rollout, stream
from nmpm.processors import Pointwise


def emulator_of(scene, scale: float, frames: int = 4) -> Emulator:
    torch.manual_seed(0)
    emulator = EmulatorRecipe(scene, 16, frames, processor=Pointwise(hidden=(4,))).build().eval()
    emulator.output_scale.fill_(scale)
    return emulator


def test_a_sound_rollout_is_reported_and_left_alone():
    scene = box()
    emulator, particles = emulator_of(scene, 1e-6), cloud(scene)
    monitor = Monitor(Policy.STOP)
    watched = rollout(emulator, particles, 10, monitor)
    assert torch.equal(watched, rollout(emulator, particles, 10))
    assert monitor.incidents == []
    assert "12 frames" in monitor.report()  # whole bundles
    assert "Limits passed: none." in monitor.report()


def test_stop_hands_out_what_was_sound_and_names_the_incident():
    scene = box()
    emulator, particles = emulator_of(scene, 1e-6), cloud(scene, speed=0.0)
    monitor = Monitor(Policy.STOP, speed=0.05)  # of falling: reached after about 13 frames
    handed = []
    with pytest.raises(RolloutStoppedError, match=r"stopped: speed 0\.\d+ \(limit 0.05\) in scene 0 by frame 4"):
        handed.extend(stream(emulator, particles, 100, monitor))
    assert 1 < len(handed) < 25
    assert [incident.what for incident in monitor.incidents] == ["speed"]


def test_warn_speaks_once_for_each_kind():
    scene = box()
    emulator, particles = emulator_of(scene, 5.0), cloud(scene)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        monitor = Monitor(Policy.WARN, speed=0.1)
        rollout(emulator, particles, 40, monitor)
    kinds = [incident.what for incident in monitor.incidents]
    assert sorted(set(kinds)) == sorted(kinds)
    assert {"speed", "energy"} <= set(kinds)
    assert len(heard) == len(kinds)


def test_record_is_silent():
    scene = box()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        monitor = Monitor(Policy.RECORD, speed=0.1)
        rollout(emulator_of(scene, 5.0), cloud(scene), 40, monitor)
    assert monitor.incidents


def test_crowding_is_the_fullest_cell():
    scene = box(particle_volume=0.01**2)
    emulator = emulator_of(scene, 1e-6)
    state = resting(scene, lattice(((0.3, 0.6), (0.3, 0.6)), 0.01))
    packed = state.moved(0.45 + 0.5 * (state.position - 0.45), state.velocity)
    for start, expected in ((state, 1.0), (packed, 4.0)):
        monitor = Monitor(Policy.RECORD, crowding=2.0)
        rollout(emulator, start, 4, monitor)
        assert monitor.peaks["crowding"] == pytest.approx(expected, rel=0.2)
        assert bool(monitor.incidents) == (expected > 2)


def test_one_monitor_watches_rollout_after_rollout():
    scene = box()
    monitor = Monitor(Policy.RECORD, speed=0.1)
    rollout(emulator_of(scene, 5.0), cloud(scene), 40, monitor)
    rollout(emulator_of(scene, 1e-6), cloud(scene), 4, monitor)
    assert monitor.incidents == []


def test_energy_is_not_watched_where_gravity_is_unknown():
    scene = box(gravity=None)
    monitor = Monitor(Policy.RECORD)
    rollout(emulator_of(scene, 5.0), cloud(scene), 40, monitor)
    assert "energy" not in monitor.peaks


def test_nothing_to_watch():
    scene = box()
    monitor = Monitor(Policy.STOP)
    assert rollout(emulator_of(scene, 1.0), cloud(scene, count=0), 4, monitor).shape == (1, 4, 0, 2)


def test_what_is_no_number_in_the_middle_is_caught():
    scene = box()
    emulator = emulator_of(scene, 1e-6)
    monitor = Monitor(Policy.STOP)
    made = stream(emulator, cloud(scene), 40, monitor)
    next(made)
    emulator.output_scale.fill_(float("nan"))
    with pytest.raises(RolloutStoppedError, match="not finite"):
        next(made)


class TestBounds:
    def falling(self, rule: str) -> torch.Tensor:
        scene = box()
        torch.manual_seed(0)
        emulator = (
            EmulatorRecipe(scene, 16, 4, processor=Pointwise(hidden=(4,)), constraints=Constraints(bounds=rule))
            .build()
            .eval()
        )
        emulator.output_scale.fill_(1e-9)
        particles = cloud(scene, speed=0.0)
        particles = particles.moved(particles.position, torch.tensor([0.0, -0.03]).expand_as(particles.position))
        return rollout(emulator, particles, 24)

    def test_stop(self):
        predicted = self.falling("stop")
        assert predicted[..., 1].min().item() == pytest.approx(0.1, abs=1e-6)
        assert (predicted[..., 1].diff(dim=1) <= 1e-6).all()

    def test_reflect(self):
        predicted = self.falling("reflect")
        assert predicted[..., 1].min() >= 0.1 - 1e-6
        assert predicted[..., 1].diff(dim=1).max() > 0.01  # up again

    def test_error(self):
        scene = box()
        emulator = EmulatorRecipe(
            scene, 16, 4, processor=Pointwise(hidden=(4,)), constraints=Constraints(bounds="error")
        ).build()
        particles = cloud(scene)
        fast = particles.moved(particles.position, torch.full_like(particles.position, 0.5))
        with pytest.raises(ValueError, match=r"particle 0: predicted at .* more than one beyond"):
            rollout(emulator.eval(), fast, 4)

    def test_unknown(self):
        with pytest.raises(ValueError, match="bounds = 'wrap' is not one of stop, reflect, error"):
            Constraints(bounds="wrap")
