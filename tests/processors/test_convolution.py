"""Convolutions and their gradients on grids of few cells, in the precisions that trainings use."""

import os
import subprocess
import sys
from itertools import product
from operator import call

import pytest
import torch

from nmpm.processors import Axial, ConvNeXt, Patched, UNet, UNetModern
from nmpm.processors.base import GridLayout
from nmpm.processors.convolution import CONVOLUTIONS, TRANSPOSED, Convolution, Upsampling, embed_patches, return_patches

CHANNELS = 24
EXHAUSTIVE = pytest.mark.slow


def fill_freed_memory():
    """Leave large numbers in memory that the next tensors are given, so that what is not computed is seen."""
    for size in (64, 256, 1024, 4096, 16384):
        del [torch.full((size,), 1e6) for _ in range(20)][:]


def results_and_gradients(layer, grid, apply, precision):
    grid = grid.detach().requires_grad_()
    layer.zero_grad()
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16):
        out = apply(layer, grid)
    torch.manual_seed(1)
    out.backward(torch.randn(out.shape, dtype=torch.float64).bfloat16().to(out.dtype))
    return [out.detach(), grid.grad, *(parameter.grad.clone() for parameter in layer.parameters())]


def rounding_error(weight, precision):
    """The error that a convolution may make, relative to its largest result: n roundings of random sign make √n of one.

    In float32 each product is added with a rounding. In bfloat16 products are added in float32 over channels, but on
    processors without instructions for it torch rounds and adds those sums in bfloat16, once per cell of the kernel.
    """
    cells = weight[0, 0].numel()
    roundings = cells if precision == torch.bfloat16 else cells * max(weight.shape[:2])
    return torch.finfo(precision).eps / 2 * roundings**0.5


def assert_as_in_double(layer, grid, apply, precision):
    """Everything agrees with the same in float64, which has loops of its own, to `rounding_error`."""
    for tensor in layer.state_dict().values():
        tensor.copy_(tensor.bfloat16())
    grid = grid.bfloat16().float()
    fill_freed_memory()
    found = results_and_gradients(layer, grid, apply, precision)
    expected = results_and_gradients(layer.double(), grid.double(), apply, torch.float64)
    tolerance = rounding_error(next(layer.parameters()), precision)
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert (one - other).abs().max() <= tolerance * other.abs().max(), grid.shape


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize(
    ("periodic", "few"),
    [
        ((True, False), (1, 3)),
        ((False,) * 3, (1, 3)),
        *(pytest.param((wraps, *(False,) * dim), (1, 2, 3, 6), marks=EXHAUSTIVE) for dim in (1, 2) for wraps in (0, 1)),
    ],
)
def test_few_cells_are_halved_and_doubled_as_in_double_precision(periodic, few, precision):
    for cells in product(few, repeat=len(periodic)):
        torch.manual_seed(0)
        fine = torch.randn(2, CHANNELS, *(2 * n for n in cells))
        assert_as_in_double(Convolution(CHANNELS, CHANNELS, 4, periodic, stride=2), fine, call, precision)
        coarse = torch.randn(2, CHANNELS, *cells)
        assert_as_in_double(Upsampling(CHANNELS, periodic), coarse, call, precision)


@EXHAUSTIVE
@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("dim", [2, 3])
def test_few_patches_are_taken_and_returned_as_in_double_precision(dim, precision):
    for cells in product((1, 2, 6), repeat=dim):
        torch.manual_seed(0)
        fine = torch.randn(2, CHANNELS, *(4 * n for n in cells))
        embed = CONVOLUTIONS[dim](CHANNELS, CHANNELS, 4, 4)
        assert_as_in_double(embed, fine, lambda layer, grid: embed_patches(layer, grid, 4), precision)
        coarse = torch.randn(2, CHANNELS, *cells)
        back = TRANSPOSED[dim](CHANNELS, CHANNELS, 4, 4)
        assert_as_in_double(back, coarse, lambda layer, grid: return_patches(layer, grid, 4), precision)


@EXHAUSTIVE
@pytest.mark.parametrize("channels", [8, 12, CHANNELS])
@pytest.mark.parametrize("kernel", [3, 5, 7])
def test_three_dimensions_of_few_cells_are_convolved_as_in_double_precision(kernel, channels):
    for cells in product((1, 2, 3), (1, 2, 6), (1, 3, 6)):
        torch.manual_seed(0)
        layer = Convolution(channels, channels, kernel, (False,) * 3)
        grid = torch.randn(2, channels, *cells)
        assert_as_in_double(layer, grid, call, torch.bfloat16)


@EXHAUSTIVE
@pytest.mark.skipif(not torch.cpu._is_avx2_supported(), reason="the variables limit the instructions of x86 alone")
@pytest.mark.parametrize("instructions", ["AVX2", "AVX512_CORE"])
def test_convolutions_are_as_in_double_precision_on_processors_with_fewer_instructions(instructions):
    if instructions == "AVX512_CORE" and not torch.cpu._is_avx512_supported():
        pytest.skip("this processor has no AVX-512")
    chosen = "three_dimensions and (5-8 or 3-24) or halved and periodic0"
    environment = os.environ | {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": instructions}
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "", __file__, "-k", chosen]
    run = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert run.returncode == 0, run.stdout
    assert "4 passed" in run.stdout


LAYOUTS = [GridLayout(5, 2, 8, (False, False)), GridLayout(5, 2, 8, (True, False)), GridLayout(6, 3, 2, (False,) * 3)]


@pytest.mark.parametrize("layout", LAYOUTS, ids=["box", "channel", "room"])
@pytest.mark.parametrize("recipe", [UNet(), UNetModern(), ConvNeXt(), Axial(), Patched(Axial())], ids=str)
def test_processors_in_bfloat16_predict_what_they_do_in_float32(recipe, layout):
    torch.manual_seed(0)
    network = recipe.build(layout)
    cells = (32, 32) if layout.dim == 2 else (8, 16, 8)
    grid = torch.randn(2, layout.in_channels, *cells)
    with torch.no_grad():
        expected = network(grid)
        fill_freed_memory()
        with torch.autocast("cpu", torch.bfloat16):
            found = network(grid)
    assert (found - expected).square().mean() <= 0.05**2 * expected.square().mean()
