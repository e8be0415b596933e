import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import FNO, GridLayout, Pointwise, UNet
from nmpm.testing import ProcessorContract


class TestUNet(ProcessorContract):
    recipe = UNet(width=6, depth=2, perceptron=(5,))


class TestFNO(ProcessorContract):
    recipe = FNO(modes=4, width=6, layers=2)


class TestPointwise(ProcessorContract):
    recipe = Pointwise(hidden=(6,))


@pytest.mark.parametrize(("depth", "parameters"), [(3, 875_280), (4, 1_117_200)])
def test_unet_has_the_published_number_of_parameters(depth, parameters):
    network = UNet(depth=depth).build(GridLayout(4, 2, 8, (False, False)))
    assert sum(p.numel() for p in network.parameters()) == parameters


def test_unet_commutes_with_shifts_along_a_periodic_axis():
    network = UNet(width=6, depth=2, perceptron=(5,)).build(GridLayout(3, 2, 2, (True, False)))
    grid = torch.randn(1, 3, 16, 12)
    shifted = network(grid.roll(4, 2))
    torch.testing.assert_close(shifted, network(grid).roll(4, 3), rtol=1e-5, atol=1e-6)


def test_pointwise_sees_only_its_own_cell():
    network = Pointwise(hidden=(6,)).build(GridLayout(2, 2, 1, (False, False)))
    grid = torch.randn(1, 2, 8, 8)
    changed = grid.clone()
    changed[..., 3, 5] += 1
    moved = (network(changed) - network(grid)).abs().sum((0, 1, 2)) > 0
    assert moved.nonzero().tolist() == [[3, 5]]


def test_unet_refuses_a_grid_smaller_than_its_depth():
    small = Grid((7, 64), (0.0, 0.0), (1.0, 1.0), (False, False))
    with pytest.raises(ConfigError, match=r"too small for a U-Net of depth 3.*at least 8 cells"):
        UNet(depth=3).check_grid(small)
    with pytest.raises(ConfigError, match="periodic"):
        UNet(depth=3).check_grid(Grid((20, 64), (0.0, 0.0), (1.0, 1.0), (True, False)))


@pytest.mark.parametrize("recipe", [UNet(width=0), UNet(kernel=2), FNO(modes=0), FNO(padding=2.0)])
def test_impossible_hyperparameters_are_named(recipe):
    with pytest.raises(ConfigError, match=type(recipe).__name__):
        recipe.build(GridLayout(3, 2, 1, (False, False)))
