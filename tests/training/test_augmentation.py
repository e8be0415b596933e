import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.sim import load_preset, preset_names
from nmpm.training.augmentation import check_jitter, check_mirrors, mirror_half, mirror_windows, with_jitter
from tests.scenes import box, cloud, emulator_of, window_of


def test_a_mirror_image_reflects_one_axis_of_the_chosen_windows_about_the_middle():
    scene = box(gravity=(1.0, -9.81), gravity_varies=True, obstacles=True)
    particles, chosen = cloud(scene, batch=3, statics=4), torch.tensor([True, False, True])
    moved = torch.arange(4).view(1, -1, 1, 1) * particles.velocity[:, None]
    window = window_of(particles, particles.position[:, None] + moved)
    image = mirror_windows(window, 0, 0.5, chosen)
    assert torch.allclose(image.frames[chosen][..., 0], 1.0 - window.frames[chosen][..., 0])
    assert torch.allclose(image.obstacle[chosen][..., 0], 1.0 - window.obstacle[chosen][..., 0])
    assert torch.equal(image.gravity[chosen][:, 0], -window.gravity[chosen][:, 0])
    assert torch.equal(image.frames[..., 1], window.frames[..., 1])
    assert torch.equal(image.frames[1], window.frames[1])
    twice = mirror_windows(image, 0, 0.5, chosen)
    assert torch.allclose(twice.frames, window.frames, atol=1e-6)
    assert torch.allclose(image.initial.velocity[chosen][..., 0], -window.initial.velocity[chosen][..., 0], atol=1e-6)


def test_only_symmetries_are_allowed():
    check_mirrors(box(), [0])
    check_mirrors(box(gravity_varies=True), [0, 1])
    with pytest.raises(ConfigError, match=r"axis 1.*-9\.81"):
        check_mirrors(box(), [1])
    with pytest.raises(ConfigError, match="no axis 2"):
        check_mirrors(box(), [2])


@pytest.mark.parametrize(
    ("changes", "middle"),
    [
        ({"domain": ((0.0, 1.0), (0.08, 0.92))}, 0.5),
        ({"domain": ((0.08, 1.4), (0.08, 0.92))}, 0.5),  # of the bounds, whose images are the same walls
        ({"bounds": ((0.1, 0.903), (0.1, 0.9))}, 0.5),  # by a particle recorded beyond the wall: of the domain
    ],
)
def test_images_have_the_same_walls(changes, middle):
    scene = box(**changes)
    particles = cloud(scene, batch=64)
    window = window_of(particles, particles.position[:, None].expand(-1, 2, -1, -1))
    image = mirror_half(window, scene, Grid.of(scene, 42), [0])
    same = (image.frames == window.frames).flatten(1).all(1)
    assert 0 < same.sum() < 64
    torch.testing.assert_close(image.frames[~same][..., 0], 2 * middle - window.frames[~same][..., 0])


@pytest.mark.parametrize("name", preset_names())
def test_embedded_datasets_can_be_mirrored(name):
    scene = load_preset(name).scene
    fall = scene.gravity or (0.0,) * scene.dim
    level = [axis for axis in range(scene.dim) if scene.gravity_varies or not fall[axis]]
    check_mirrors(scene, level)


def test_jitter_moves_the_grid_by_less_than_asked_and_keeps_the_weights():
    emulator = emulator_of(box(), frames=2)
    assert with_jitter(emulator, 0.0) is emulator
    moves = []
    for _ in range(200):
        moved = with_jitter(emulator, 0.25)
        assert moved.processor is emulator.processor
        moves.append((torch.tensor(moved.grid.lower) - torch.tensor(emulator.grid.lower)) / emulator.grid.spacing[0])
    assert torch.stack(moves).abs().max() <= 0.25 + 1e-6
    assert (torch.stack(moves).amin(0) < -0.2).all()
    assert (torch.stack(moves).amax(0) > 0.2).all()


@pytest.mark.parametrize(
    ("changes", "limits"),
    [
        ({}, (0.3, 0.3)),
        ({"bounds": ((0.081, 0.919), (0.1, 0.9))}, (0.019, 0.3)),  # of 0.0525 each
        ({"bounds": ((0.1, 0.9), (0.08, 0.92))}, (0.3, 0.0)),
        ({"bounds": ((0.08, 0.92),) * 2, "boundary": ("periodic",) * 2, "gravity": (0.0, 0.0)}, (0.3, 0.3)),
    ],
)
def test_jitter_leaves_walls_on_the_grid(changes, limits):
    emulator = emulator_of(box(**changes), frames=2)
    moved = [with_jitter(emulator, 0.3).grid.lower for _ in range(300)]  # raises if a wall leaves it
    steps = (torch.tensor(moved) - torch.tensor(emulator.grid.lower)) / torch.tensor(emulator.grid.spacing)
    assert (steps.abs().amax(0) <= torch.tensor(limits) + 1e-3).all()
    assert (steps.abs().amax(0) >= 0.9 * torch.tensor(limits) - 1e-6).all()


@pytest.mark.parametrize(
    ("changes", "cells", "message"),
    [
        ({}, 0.51, "from 0 to 0.5"),
        ({}, -0.1, "from 0 to 0.5"),
        ({"bounds": ((0.08, 0.92),) * 2}, 0.1, "which this scene lacks"),
    ],
)
def test_a_jitter_that_cannot_be_is_refused(changes, cells, message):
    scene = box(**changes)
    check_jitter(scene, Grid.of(scene, 16), 0.0)
    with pytest.raises(ConfigError, match=message):
        check_jitter(scene, Grid.of(scene, 16), cells)
