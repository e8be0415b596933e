import pytest
import torch

from nmpm._support.plain_data import from_spec, to_spec
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import (
    FFNO,
    FNO,
    TFNO,
    Axial,
    ConvNeXt,
    GridLayout,
    Identity,
    Patched,
    Pointwise,
    Processor,
    Stochastic,
    UNet,
    UNetModern,
)
from nmpm.processors.convolution import cells_to_channels, channels_to_cells
from nmpm.testing import ProcessorContract


class TestUNet(ProcessorContract):
    recipe = UNet(width=6, depth=2, perceptron=(5,))


class TestFNO(ProcessorContract):
    recipe = FNO(modes=4, width=6, layers=2)


class TestTFNO(ProcessorContract):
    recipe = TFNO(modes=4, width=6, layers=2, rank=0.5)


class TestFFNO(ProcessorContract):
    recipe = FFNO(modes=4, width=6, layers=2)


class TestUNetModern(ProcessorContract):
    recipe = UNetModern(width=4, growth=(1, 2, 3))


class TestUNetModernWithNorm(ProcessorContract):
    recipe = UNetModern(width=4, growth=(1, 2), blocks=2, groups=2)


class TestConvNeXt(ProcessorContract):
    recipe = ConvNeXt(width=6, depth=2, kernel=5)


class TestAxial(ProcessorContract):
    recipe = Axial(width=16, layers=2, heads=2, patch=4)


class TestStochastic(ProcessorContract):
    recipe = Stochastic(Patched(UNet(width=6, depth=1, perceptron=(5,))), fine=1, coarse=2, block=3)


class TestPatched(ProcessorContract):
    recipe = Patched(UNet(width=6, depth=1, perceptron=(5,)))


class TestIdentity(ProcessorContract):
    recipe = Identity()


class TestPointwise(ProcessorContract):
    recipe = Pointwise(hidden=(6,))


@pytest.mark.parametrize(("depth", "parameters"), [(3, 875_280), (4, 1_117_200)])
def test_unet_has_the_published_number_of_parameters(depth, parameters):
    network = UNet(depth=depth).build(GridLayout(4, 2, 8, (False, False)))
    assert sum(p.numel() for p in network.parameters()) == parameters


SMALL = [
    UNet(width=6, depth=2, perceptron=(5,)),
    UNetModern(width=4, growth=(1, 2, 3)),
    ConvNeXt(width=6, depth=2, kernel=5),
    FNO(modes=4, width=6, layers=2),
    FFNO(modes=4, width=6, layers=2),
    Axial(width=16, layers=2, heads=2, patch=4),
    Patched(UNet(width=6, depth=1, perceptron=(5,))),
    Pointwise(hidden=(6,)),
    Identity(),
]


@pytest.mark.parametrize("recipe", SMALL)
@pytest.mark.parametrize("shape", [(16, 12), (8, 8, 12)])
def test_commutes_with_shifts_along_a_periodic_axis(recipe, shape):
    periodic = (True,) + (False,) * (len(shape) - 1)
    network = recipe.build(GridLayout(3, 2, 2, periodic))
    grid = torch.randn(1, 3, *shape)
    shifted = network(grid.roll(4, 2))
    torch.testing.assert_close(shifted, network(grid).roll(4, 3), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("shape", "patch"), [((12,), 4), ((8, 12), 2), ((4, 8, 12), 4), ((8, 12), 1)])
def test_cells_go_to_channels_of_their_patch_and_back(shape, patch):
    grid = torch.randn(2, 3, *shape)
    coarse = cells_to_channels(grid, patch)
    assert coarse.shape == (2, 3 * patch ** len(shape), *(n // patch for n in shape))
    assert torch.equal(channels_to_cells(coarse, patch), grid)
    first = coarse[(0, slice(0, patch ** len(shape)), *(0,) * len(shape))]
    assert torch.equal(first, grid[(0, 0, *(slice(0, patch),) * len(shape))].flatten())


def test_a_patched_processor_is_the_same_from_yaml_and_names_bad_grids():
    plain = {"class_path": "nmpm.processors.UNet", "init_args": {"width": 6, "depth": 2, "perceptron": [5]}}
    recipe = Patched(plain, patch=2)
    assert recipe == Patched(UNet(width=6, depth=2, perceptron=(5,)))
    assert from_spec(to_spec(recipe), Processor) == recipe
    with pytest.raises(ConfigError, match="too small for a U-Net of depth 2"):
        recipe.check_grid(Grid((6, 64), (0.0, 0.0), (1.0, 1.0), (False, False)))
    with pytest.raises(ConfigError, match="periodic"):
        recipe.check_grid(Grid((20, 64), (0.0, 0.0), (1.0, 1.0), (True, False)))
    with pytest.raises(ConfigError, match="Patched needs patches"):
        Patched(patch=0)


def test_pointwise_sees_only_its_own_cell():
    network = Pointwise(hidden=(6,)).build(GridLayout(2, 2, 1, (False, False)))
    grid = torch.randn(1, 2, 8, 8)
    changed = grid.clone()
    changed[..., 3, 5] += 1
    moved = (network(changed) - network(grid)).abs().sum((0, 1, 2)) > 0
    assert moved.nonzero().tolist() == [[3, 5]]


@pytest.mark.parametrize(
    "recipe",
    [
        UNet(width=0),
        UNet(kernel=2),
        FNO(modes=0),
        FNO(padding=2.0),
        TFNO(rank=0.0),
        FFNO(layers=0),
        UNetModern(growth=()),
        UNetModern(width=6, groups=4),
        ConvNeXt(kernel=4),
        Axial(width=30, heads=4),
    ],
)
def test_impossible_hyperparameters_are_named(recipe):
    with pytest.raises(ConfigError, match=type(recipe).__name__):
        recipe.build(GridLayout(3, 2, 1, (False, False)))


@pytest.mark.parametrize("recipe", [FNO(modes=4, width=6, layers=2), TFNO(modes=4, width=6, layers=2, rank=0.5)])
def test_fourier_operators_ignore_autocast(recipe):
    torch.manual_seed(0)
    network, grid = recipe.build(GridLayout(4, 2, 3, (False, False))).eval(), torch.randn(2, 4, 16, 16)
    with torch.autocast("cpu", torch.bfloat16):
        inside, half = network(grid), network(grid.bfloat16())
    assert torch.equal(inside, network(grid))
    assert half.dtype == torch.float32


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.bfloat16, 0.05), (torch.float64, 1e-5)])
def test_a_factorised_fourier_operator_takes_weights_of_any_precision(dtype, tolerance):
    torch.manual_seed(0)
    network = FFNO(modes=4, width=6, layers=2).build(GridLayout(4, 2, 3, (False, False))).eval()
    grid = torch.randn(2, 4, 16, 16)
    expected = network(grid)
    found = network.to(dtype)(grid.to(dtype))
    assert found.dtype == dtype
    assert (found - expected).abs().max() < tolerance * expected.abs().max()
