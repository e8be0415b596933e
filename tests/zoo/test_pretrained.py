"""What a loaded model does beside rolling out."""

import dataclasses

import pytest
import torch

from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.processors import UNet
from nmpm.zoo import Pretrained
from tests.scenes import box


@pytest.fixture
def model():
    torch.manual_seed(0)
    recipe = EmulatorRecipe(box(), cells=8, frames=2, processor=UNet(width=4, depth=1, perceptron=(4,)))
    return Pretrained(recipe.build().eval().requires_grad_(False), {"name": "small"})


def test_over_a_wider_domain_the_same_weights_get_more_cells_of_the_same_size(model):
    wide = dataclasses.replace(model.scene, bounds=((0.1, 1.74), (0.1, 0.9)), domain=((0.08, 1.76), (0.08, 0.92)))
    wider = model.over(wide)
    assert wider.scene == wide
    assert wider.emulator.grid.shape == (16, 8)
    assert wider.card == model.card
    assert model.emulator.grid.shape == (8, 8)
    for name, value in model.emulator.state_dict().items():
        assert torch.equal(wider.emulator.state_dict()[name], value)
    state = wider.example(count=200, blocks=2)
    positions = wider.rollout(state, frames=5)
    assert positions.shape == (1, 5, state.position.shape[1], 2)
    assert bool((positions[..., 0] <= 1.74).all())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 1.0}, "dt"),
        ({"materials": ("sand",)}, "input_channels"),
        ({"gravity": (0.0, 0.0)}, "gravity"),
        ({"domain": ((0.08, 0.97), (0.08, 0.92))}, "whole numbers"),
    ],
)
def test_scenes_that_a_model_cannot_take_are_refused(model, change, message):
    with pytest.raises(ConfigError, match=message):
        model.over(dataclasses.replace(model.scene, **change))


def test_a_model_prints_as_one_line(model):
    weights = sum(values.numel() for values in model.emulator.parameters())
    assert repr(model) == f"<Pretrained small: unknown data, UNet of {weights:,} parameters on cpu>"
