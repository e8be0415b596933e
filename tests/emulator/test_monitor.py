import warnings

import pytest
import torch
from scenes import box, cloud

from nmpm.data.initial_states import lattice, state_at_rest
from nmpm.decoders import Flip
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


class TestBounds:
    @pytest.mark.parametrize("rule", ["stop", "reflect"])
    def test_what_falls_stops_at_the_floor_or_comes_up_again(self, rule):
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
        predicted = rollout(emulator, particles, 24)
        assert predicted[..., 1].min() >= 0.1 - 1e-6
        assert (predicted[..., 1].diff(dim=1).max() > 0.01) == (rule == "reflect")

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
