import pytest
import torch
from scenes import box, cloud

from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.training.augmentation import check_mirrors, mirror_windows


def window_of(scene, batch=3):
    particles = cloud(scene, batch=batch, statics=4)
    frames = particles.position[:, None] + torch.arange(4).view(1, -1, 1, 1) * particles.velocity[:, None]
    rest = (particles.material, particles.mask, particles.obstacle, particles.obstacle_mask, particles.gravity)
    return Window(frames, *rest)


def test_a_mirror_image_reflects_one_axis_of_the_chosen_windows_about_the_middle():
    scene = box(gravity=(1.0, -9.81), gravity_varies=True, obstacles=True)
    window, chosen = window_of(scene), torch.tensor([True, False, True])
    image = mirror_windows(window, scene, 0, chosen)
    assert torch.allclose(image.frames[chosen][..., 0], 1.0 - window.frames[chosen][..., 0])
    assert torch.allclose(image.obstacle[chosen][..., 0], 1.0 - window.obstacle[chosen][..., 0])
    assert torch.equal(image.gravity[chosen][:, 0], -window.gravity[chosen][:, 0])
    assert torch.equal(image.frames[..., 1], window.frames[..., 1])
    assert torch.equal(image.frames[1], window.frames[1])
    twice = mirror_windows(image, scene, 0, chosen)
    assert torch.allclose(twice.frames, window.frames, atol=1e-6)
    assert torch.allclose(image.initial.velocity[chosen][..., 0], -window.initial.velocity[chosen][..., 0], atol=1e-6)


def test_only_symmetries_are_allowed():
    check_mirrors(box(), [0])
    check_mirrors(box(gravity_varies=True), [0, 1])
    with pytest.raises(ConfigError, match=r"axis 1.*-9\.81"):
        check_mirrors(box(), [1])
    with pytest.raises(ConfigError, match="no axis 2"):
        check_mirrors(box(), [2])
