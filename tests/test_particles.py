import dataclasses

import pytest
import torch
from scenes import box, cloud, emulator_of

from nmpm.emulator import rollout
from nmpm.particles import Particles, Window

KEPT = {"material": torch.int64, "mask": torch.bool, "obstacle_mask": torch.bool}


def state(batch: int = 3) -> Particles:
    return cloud(box(), count=5, batch=batch, statics=2)


def tensors(whole):
    """All tensors by name, those of fields among them."""
    found = vars(whole)
    return {name: values for name, values in found.items() if isinstance(values, torch.Tensor)} | dict(found["fields"])


@pytest.mark.parametrize("whole", [state(), Window.of(state())], ids=["Particles", "Window"])
def test_double_leaves_indices_and_masks(whole):
    for name, values in tensors(whole.double()).items():
        assert values.dtype == KEPT.get(name, torch.float64)
        torch.testing.assert_close(values, tensors(whole)[name], check_dtype=False, rtol=0, atol=0)


@pytest.mark.parametrize("whole", [state(), Window.of(state())], ids=["Particles", "Window"])
def test_some_scenes_are_views(whole):
    some = whole.scenes(slice(1, 3))
    for name, values in tensors(some).items():
        assert torch.equal(values, tensors(whole)[name][1:])
        assert values.untyped_storage().data_ptr() == tensors(whole)[name].untyped_storage().data_ptr()


def test_stacked_states_of_any_size_move_as_alone():
    scene = box(materials=("water", "sand"), obstacles=True)
    emulator = emulator_of(scene, energy=True, density_cap=0.3)
    states = [cloud(scene, 300, 2), cloud(scene, 7, statics=5), cloud(scene, 90, seed=1, statics=9)]
    whole = Particles.stack(states)
    assert whole.mask.sum(1).tolist() == [300, 300, 7, 90]
    assert whole.obstacle_mask.sum(1).tolist() == [0, 0, 5, 9]
    path = rollout(emulator, whole, 6)
    for first, each in zip((0, 2, 3), states, strict=True):
        batch, count = each.mask.shape
        torch.testing.assert_close(
            path[first : first + batch, :, :count], rollout(emulator, each, 6), rtol=0, atol=1e-6
        )
    warm = dataclasses.replace(states[0], fields={"heat": torch.zeros(2, 300)})
    with pytest.raises(ValueError, match="the fields heat"):
        Particles.stack([warm, states[1]])


def test_a_window_of_a_state_starts_there_and_predicts_nothing():
    start = state()
    window = Window.of(start)
    assert window.target.shape == (3, 0, 5, 2)
    for name, values in vars(window.initial).items():
        torch.testing.assert_close(values, getattr(start, name), rtol=0, atol=1e-7)


def test_padding_to_a_multiple_adds_particles_that_are_not_there():
    state_ = state()
    whole = Window.of(dataclasses.replace(state_, fields={"t": torch.rand(3, 5), "angle": torch.rand(3, 1)}))
    present, share = torch.ones(3, 2, 5, dtype=torch.bool), torch.ones(3, 2)
    window = dataclasses.replace(whole, present=present, obstacle_share=share).padded(4)
    shapes = {name: tuple(values.shape) for name, values in tensors(window).items()}
    assert shapes["frames"] == (3, 2, 8, 2)
    assert shapes["obstacle"] == (3, 4, 2)
    assert (shapes["t"], shapes["angle"]) == ((3, 1, 8), (3, 1, 1))
    assert torch.equal(window.mask, torch.arange(8).expand(3, -1) < 5)
    assert torch.equal(window.obstacle_mask, torch.arange(4).expand(3, -1) < 2)
    assert not window.present[..., 5:].any()
    assert tensors(whole.padded(1)).keys() == tensors(whole).keys()
    assert whole.padded(5).frames is whole.frames
