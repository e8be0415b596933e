"""The mean acceleration over the last frames, as a further input of the network."""

import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.data.loading.padded_batch import PaddedRecordings, collate
from nmpm.data.loading.recording import Recording
from nmpm.emulator import Emulator, EmulatorRecipe, rollout, unroll
from nmpm.emulator.calibration import calibrate
from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.processors import UNet
from nmpm.scene import Scene
from nmpm.training.augmentation import mirror_windows
from nmpm.training.module import EmulatorModule
from nmpm.transfer import Affine, Linear, Nearest, Quadratic

SMALL = UNet(width=4, depth=1, perceptron=(4,))
CHANNEL = {"boundary": ("periodic", "wall"), "domain": ((0.1, 0.9), (0.08, 0.92))}


def small(scene: Scene, history: int, frames: int = 3, transfer=Linear()) -> Emulator:
    torch.manual_seed(0)
    return EmulatorRecipe(scene, 16, frames, transfer, SMALL, history=history).build().eval()


def accelerated(scene: Scene, frames: int = 12, count: int = 20) -> Recording:
    """Particles that accelerate by t² from rest, beside gravity, unwrapped where an axis is periodic."""
    generator = torch.Generator().manual_seed(0)
    start = 0.3 + 0.4 * torch.rand(1, count, scene.dim, generator=generator)
    change = 1e-4 * torch.arange(frames).view(-1, 1, 1) ** 2
    return Recording(
        frames=start + change.cumsum(0).cumsum(0),
        material=torch.zeros(count, dtype=torch.int64),
        obstacle=torch.zeros(0, scene.dim),
        gravity=torch.zeros(scene.dim),
    )


@pytest.mark.parametrize("transfer", [Nearest(), Linear(), Quadratic(), Affine()])
def test_the_grid_holds_each_materials_mean_acceleration_in_cells(transfer):
    scene = box(materials=("water", "sand"))
    particles, emulator = cloud(scene, count=200), small(scene, 2, transfer=transfer)
    by_material = torch.tensor([[1e-3, 2e-3], [-3e-3, 0.0]])[particles.material]
    state = dataclasses.replace(particles, acceleration=by_material)
    grid = emulator.grid_state(state, emulator.solid(state))
    names = emulator.recipe.input_channels
    assert grid.shape[1] == len(names)
    for name, value in {"water.acceleration_x": 1e-3, "water.acceleration_y": 2e-3, "sand.acceleration_x": -3e-3}.items():
        found = grid[0, names.index(name)]
        filled = grid[0, names.index(f"{name.partition('.')[0]}.volume")] > 1e-6
        expected = torch.full_like(found[filled], value / emulator.grid.spacing[0])
        torch.testing.assert_close(found[filled], expected, rtol=1e-3, atol=1e-6)


def test_windows_have_the_mean_second_difference_of_the_frames_before():
    scene = box(gravity=None)
    padded = PaddedRecordings.stack([accelerated(scene)], scene)
    window = padded.gather([0, 0, 0], [0, 1, 6], 4, history=3)
    t = torch.tensor([0.0, 2.0, 7.0])
    velocity = 1e-4 * torch.stack([(torch.arange(s + 1) ** 2).sum().float() for s in range(10)])
    expected = torch.tensor([0.0, velocity[2] - velocity[1], (velocity[7] - velocity[4]) / 3])
    found = window.acceleration[:, 0, 0]
    assert t.shape == found.shape
    torch.testing.assert_close(found, expected, atol=2e-7, rtol=1e-4)
    assert window.initial.acceleration is window.acceleration


def test_windows_without_history_are_as_they_were():
    scene = box()
    recording = accelerated(scene)
    assert collate([recording], scene).acceleration is None
    with_it = PaddedRecordings.stack([recording], scene).gather([0], [4], 5, history=2)
    without = PaddedRecordings.stack([recording], scene).gather([0], [4], 5)
    assert torch.equal(with_it.frames, without.frames)


def test_gravity_does_not_count_and_free_fall_is_zero():
    scene = box()
    gravity = torch.tensor(scene.gravity) * scene.dt**2
    steps = torch.arange(12).view(-1, 1, 1)
    falling = dataclasses.replace(
        accelerated(scene), frames=0.8 + gravity * steps * (steps + 1) / 2 + torch.zeros(12, 5, 2), gravity=gravity
    )
    falling = dataclasses.replace(falling, material=torch.zeros(5, dtype=torch.int64))
    window = PaddedRecordings.stack([falling], scene).gather([0], [5], 4, history=4)
    assert window.acceleration.abs().max() < 1e-7


def test_a_border_that_wraps_is_no_acceleration():
    scene = box(gravity=None, **CHANNEL)
    plain = accelerated(scene)
    wrapped = plain.frames.clone()
    wrapped[..., 0] = 0.1 + (wrapped[..., 0] + 0.35 - 0.1).remainder(0.8)
    found = PaddedRecordings.stack([dataclasses.replace(plain, frames=wrapped)], scene).gather([0], [5], 4, history=4)
    expected = PaddedRecordings.stack([plain], scene).gather([0], [5], 4, history=4)
    torch.testing.assert_close(found.acceleration, expected.acceleration, atol=1e-6, rtol=0)


@pytest.mark.parametrize("history", [1, 2, 3])
def test_a_bundle_ends_with_the_mean_acceleration_of_its_last_frames(history):
    scene = box()
    particles, emulator = cloud(scene), small(scene, history)
    bundle = emulator(particles)
    path = torch.cat([(particles.position - particles.velocity)[:, None], particles.position[:, None], bundle.position], 1)
    velocity = path.diff(dim=1)
    expected = (velocity[:, -1] - velocity[:, -1 - history]) / history - particles.gravity.unsqueeze(1)
    torch.testing.assert_close(bundle.acceleration, expected, atol=2e-7, rtol=0)


@pytest.mark.parametrize("history", [0, 2])
def test_a_rollout_that_goes_on_from_its_state_equals_the_uninterrupted_one(history):
    scene = box()
    state, emulator = cloud(scene), small(scene, history)
    whole = rollout(emulator, state, 12)
    with torch.no_grad():
        for bundle in unroll(emulator, state, 2):
            state = bundle.end(state)
    assert torch.equal(rollout(emulator, state, 6), whole[:, 6:])


def test_the_acceleration_reaches_the_network():
    scene = box()
    state, emulator = cloud(scene), small(scene, 2)
    pushed = dataclasses.replace(state, acceleration=torch.full_like(state.velocity, 1e-2))
    fallen = dataclasses.replace(state, acceleration=torch.zeros_like(state.velocity))
    assert not torch.equal(rollout(emulator, pushed, 3), rollout(emulator, state, 3))
    assert torch.equal(rollout(emulator, fallen, 9), rollout(emulator, state, 9))


def test_padding_changes_nothing():
    scene = box()
    state, emulator = cloud(scene, count=30), small(scene, 2)
    state = dataclasses.replace(state, acceleration=1e-3 * torch.randn_like(state.velocity))
    mask = torch.arange(30) < 20
    padded = dataclasses.replace(state, mask=mask[None])
    alone = dataclasses.replace(
        state,
        position=state.position[:, :20],
        velocity=state.velocity[:, :20],
        acceleration=state.acceleration[:, :20],
        material=state.material[:, :20],
        mask=state.mask[:, :20],
    )
    assert torch.equal(rollout(emulator, padded, 9)[:, :, :20], rollout(emulator, alone, 9))


def test_a_mirrored_window_accelerates_the_other_way():
    scene = box(gravity=None)
    window = PaddedRecordings.stack([accelerated(scene)], scene).gather([0], [6], 4, history=3)
    mirrored = mirror_windows(window, scene, 0, torch.tensor([True]))
    assert torch.equal(mirrored.acceleration[..., 0], -window.acceleration[..., 0])
    assert torch.equal(mirrored.acceleration[..., 1], window.acceleration[..., 1])


def test_windows_of_states_keep_it():
    state = dataclasses.replace(cloud(box()), acceleration=torch.ones(1, 30, 2))
    assert Window.of(state).initial.acceleration is state.acceleration
    assert state.double().acceleration.dtype == torch.float64


def test_calibration_covers_the_further_channels():
    scene = box(gravity=None)
    recording = accelerated(scene, frames=16)
    window = PaddedRecordings.stack([recording] * 2, scene).gather([0, 1], [4, 8], 6, history=2)
    emulator = small(scene, 2)
    calibrate(emulator, [window])
    further = emulator.recipe.input_channels.index("goop.acceleration_x")
    assert emulator.input_std[further] < 1
    assert emulator.input_high[further] > 0


def test_recomputed_gradients_are_the_same():
    scene = box()
    recording = accelerated(scene)
    window = PaddedRecordings.stack([recording], scene).gather([0], [3], 8, history=2)
    grads = []
    for recompute in (False, True):
        torch.manual_seed(0)
        module = EmulatorModule(
            scene, unroll=2, cells=16, frames=3, processor=SMALL, history=2, recompute=recompute
        )
        module.log = lambda *_, **__: None
        module.training_step(window, 0).backward()
        grads.append([parameter.grad for parameter in module.emulator.parameters()])
    for one, other in zip(*grads, strict=True):
        torch.testing.assert_close(one, other)


def test_recipes_without_history_are_written_as_before():
    scene = box()
    assert "history" not in EmulatorRecipe(scene).to_dict()
    recipe = EmulatorRecipe(scene, history=4)
    assert EmulatorRecipe.from_dict(recipe.to_dict()) == recipe


def test_a_history_longer_than_a_bundle_is_refused():
    with pytest.raises(ConfigError, match="history = 9 must be from 0 to frames = 8"):
        EmulatorRecipe(box(), history=9)
