import dataclasses
import warnings

import pytest
import torch
from scenes import box, cloud

from nmpm.data.initial_states import lattice, state_at_rest
from nmpm.decoders import Flip
from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.input_checks import check_inputs
from nmpm.emulator.monitor import Monitor, Policy, RolloutStoppedError
from nmpm.emulator.rollouts import rollout, stream
from nmpm.errors import DataError
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
    assert "10 frames" in monitor.report()
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
    state = state_at_rest(scene, lattice(((0.3, 0.6), (0.3, 0.6)), 0.01))
    packed = state.with_motion(0.45 + 0.5 * (state.position - 0.45), state.velocity)
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


class TestReadLate:
    """As on a GPU: measures stay on the device for 16 bundles."""

    @pytest.fixture(autouse=True)
    def _no_branches(self, monkeypatch):
        monkeypatch.setattr("nmpm.emulator.monitor.is_eager_cpu", lambda values: False)

    def test_what_is_seen_is_the_same(self, monkeypatch):
        scene = box()
        emulator, particles = emulator_of(scene, 5.0), cloud(scene, batch=2)
        late, early = Monitor(Policy.RECORD, speed=0.1), Monitor(Policy.RECORD, speed=0.1)
        rollout(emulator, particles, 4 * 37, late)
        monkeypatch.setattr("nmpm.emulator.monitor.is_eager_cpu", lambda values: True)
        rollout(emulator, particles, 4 * 37, early)
        assert late.incidents == early.incidents
        assert late.peaks == early.peaks
        assert late.at_walls == early.at_walls
        assert late.report() == early.report()
        assert late.incidents[0].frame < 4 * 16

    def test_it_is_read_once_in_sixteen_bundles_and_at_the_end(self, monkeypatch):
        read = []

        class Watched(Monitor):
            def read(self):
                read.append(len(self._unread))
                super().read()

        scene = box()
        rollout(emulator_of(scene, 1e-6), cloud(scene), 4 * 37, Watched(Policy.STOP))
        assert read == [16, 16, 5]

    def test_stop_comes_at_the_next_reading_and_names_the_frame(self):
        scene = box()
        emulator, particles = emulator_of(scene, 1e-6), cloud(scene, speed=0.0)
        monitor, yielded = Monitor(Policy.STOP, speed=0.05), []
        with pytest.raises(RolloutStoppedError, match=r"speed 0\.\d+ .* by frame 4"):
            yielded.extend(stream(emulator, particles, 100, monitor))
        assert len(yielded) == 15
        assert monitor.incidents[0].frame < 64

    def test_the_end_of_a_short_rollout_is_seen(self):
        scene = box()
        with pytest.raises(RolloutStoppedError, match="speed"):
            rollout(emulator_of(scene, 5.0), cloud(scene), 8, Monitor(Policy.STOP, speed=0.1))

    def test_padding_is_not_watched(self):
        scene = box()
        particles = cloud(scene)
        mask = particles.mask.clone()
        mask[:, 0] = False
        fast = particles.velocity.clone()
        fast[:, 0] = 1.0
        state = dataclasses.replace(particles, velocity=fast, mask=mask)
        monitor = Monitor(Policy.STOP)
        rollout(emulator_of(scene, 1e-6), state, 4, monitor)
        assert monitor.peaks["speed"] < 1


def test_periodic_axes_have_no_walls_to_be_at():
    scene = box(boundary=("periodic", "wall"), domain=((0.1, 0.9), (0.08, 0.92)))
    particles = cloud(scene, speed=0.0)
    position = particles.position.clone()
    position[0, :3, 0] = torch.tensor([0.1, -5.0, 7.0])
    position[0, 3:5, 1] = 0.1
    monitor = Monitor(Policy.RECORD)
    rollout(emulator_of(scene, 1e-6), particles.with_motion(position, torch.zeros_like(position)), 4, monitor)
    assert monitor.at_walls == 2


def test_inputs_are_checked_in_one_reading(monkeypatch):
    scene = box()
    emulator, particles = emulator_of(scene, 1e-6), cloud(scene)
    read, to_bool = [], torch.Tensor.__bool__
    monkeypatch.setattr(torch.Tensor, "__bool__", lambda values: read.append(values) or to_bool(values))
    check_inputs(emulator, particles)
    assert len(read) == 1


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("gravity", (1, 1), float("nan"), r"Scene 1 of the batch, its gravity is \[.*nan\]; it must be finite"),
        ("gravity", (0, 0), -float("inf"), "Scene 0 of the batch, its gravity"),
        ("obstacle", (1, 4), float("nan"), r"Scene 1 of the batch, obstacle particle 4: its position is \[nan"),
        ("material", (0, 7), 2, r"particle 7: its material is 2; .* the model's 2 \(water, sand\)"),
        ("material", (1, 7), -1, "Scene 1 of the batch, particle 7: its material is -1"),
    ],
)
def test_a_state_that_cannot_be_is_named_unless_it_is_padding(name, place, value, message):
    scene = box(materials=("water", "sand"), obstacles=True)
    particles = cloud(scene, batch=2, statics=6)
    particles = dataclasses.replace(particles, gravity=particles.gravity.clone())
    emulator = emulator_of(scene, 1e-6)
    getattr(particles, name)[place] = value
    with pytest.raises(DataError, match=message):
        check_inputs(emulator, particles)
    if name != "gravity":
        (particles.mask if name == "material" else particles.obstacle_mask)[place] = False
        check_inputs(emulator, particles)


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
        particles = particles.with_motion(particles.position, torch.tensor([0.0, -0.03]).expand_as(particles.position))
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
        fast = particles.with_motion(particles.position, torch.full_like(particles.position, 0.5))
        with pytest.raises(ValueError, match=r"particle 0: predicted at .* more than one beyond"):
            rollout(emulator.eval(), fast, 4)

    def test_padding_beyond_the_bounds_is_no_error(self):
        emulator = EmulatorRecipe(
            box(), 16, 4, processor=Pointwise(hidden=(4,)), constraints=Constraints(bounds="error")
        ).build()
        particles = cloud(box())
        particles.mask[:, 20:] = False
        particles.position[:, 20:] = -3.0
        assert rollout(emulator.eval(), particles, 4).shape[1] == 4

    def test_error_is_raised_once_per_bundle_for_real_particles_at_their_own_place(self):
        scene = box()
        parts = {"processor": Pointwise(hidden=(4,)), "decoder": Flip(), "constraints": Constraints(bounds="error")}
        emulator = EmulatorRecipe(scene, 16, 4, **parts).build()
        particles = cloud(scene, batch=2, speed=0.0)
        velocity = particles.velocity.clone()
        velocity[1, 23] = 0.7
        emulator.output_scale.fill_(1e-9)
        with pytest.raises(ValueError, match=r"Scene 1 of the batch, particle 23: .* in frame 1 of the bundle"):
            rollout(emulator.eval(), particles.with_motion(particles.position, velocity), 4)

    @pytest.mark.parametrize("rule", ["stop", "reflect", "error"])
    def test_periodic_axes_have_no_bounds(self, rule):
        scene = box(boundary=("periodic", "wall"), domain=((0.1, 0.9), (0.08, 0.92)))
        parts = {"processor": Pointwise(hidden=(4,)), "decoder": Flip(), "constraints": Constraints(bounds=rule)}
        emulator = EmulatorRecipe(scene, (16, 16), 4, **parts).build().eval()
        emulator.output_scale.fill_(1e-9)
        particles = cloud(scene, speed=0.0)
        state = particles.with_motion(particles.position, torch.tensor([0.5, 0.0]).expand_as(particles.velocity))
        moved = rollout(emulator, state, 4)[:, -1] - particles.position
        torch.testing.assert_close(moved[..., 0], torch.full((1, 30), 2.0), rtol=1e-5, atol=0)

    def test_unknown(self):
        with pytest.raises(ValueError, match="bounds = 'wrap' is not one of stop, reflect, error"):
            Constraints(bounds="wrap")
