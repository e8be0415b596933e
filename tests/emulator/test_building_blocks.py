"""The transfers at sizes, masses and shapes that no scene has."""

import pytest
import torch

from nmpm.grid import Grid
from nmpm.transfer import Affine, Linear, Nearest, Quadratic

TRANSFERS = [Nearest(), Linear(), Quadratic(), Affine()]


def grid_of(*shape: int) -> Grid:
    return Grid(shape, (0.0,) * len(shape), (1.0,) * len(shape), (False,) * len(shape))


@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("shape", [(8, 8), (2048, 3), (1, 2048), (800, 8), (7, 11, 13)])
def test_weights_sum_to_one_on_every_grid(transfer, shape):
    grid = grid_of(*shape)
    generator = torch.Generator().manual_seed(0)
    cells = torch.rand(1, 500, len(shape), generator=generator, dtype=torch.float64) * torch.tensor(shape)
    ones = torch.ones(1, 500, 1, dtype=torch.float64)
    assert transfer.p2g(ones, cells, grid).sum().item() == pytest.approx(500, rel=1e-12)
    field = torch.ones(1, 1, *shape, dtype=torch.float64)
    torch.testing.assert_close(transfer.g2p(field, cells, grid), ones, rtol=1e-12, atol=0)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_masses_over_twelve_orders_of_magnitude_keep_the_light_ones(transfer):
    """Far from each other, a heavy particle does not swallow a light one; in one cell the sum is right to rounding."""
    grid = grid_of(32, 32)
    apart = torch.tensor([[[5.2, 5.7], [25.3, 25.1]]])
    together = torch.tensor([[[5.2, 5.7], [5.2, 5.7]]])
    mass = torch.tensor([[[1e6], [1e-6]]])
    summed = transfer.p2g(mass, apart, grid)
    assert summed[..., 20:, 20:].sum().item() == pytest.approx(1e-6, rel=1e-5)
    assert transfer.p2g(mass, together, grid).sum().item() == pytest.approx(1e6, rel=1e-6)


@pytest.mark.slow
def test_ten_million_terms_in_float32_are_right_to_a_thousandth():
    """1250 to a cell, as a scene of ten million has; the error is that of adding one after the other."""
    grid, count = grid_of(100, 80), 10_000_000
    cells = torch.rand(1, count, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([100.0, 80.0])
    values = torch.full((1, count, 1), 0.1)
    single = Linear().p2g(values, cells, grid).double()
    assert single.sum().item() == pytest.approx(count * float(torch.tensor(0.1)), rel=1e-4)
    stencil = Linear().scatter_stencil(cells, grid)
    weights = (stencil.weight.double() * float(torch.tensor(0.1))).flatten()
    exact = torch.zeros(grid.size, dtype=torch.float64).scatter_add(0, stencil.node.flatten(), weights)
    assert ((single.flatten() - exact).abs() / exact).max().item() < 1e-3


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_a_channel_that_never_varies_passes_through(transfer):
    grid = grid_of(16, 16)
    cells = 16 * torch.rand(1, 200, 2, generator=torch.Generator().manual_seed(0))
    velocity = torch.full((1, 200, 2), 0.25)
    momentum, count = transfer.momentum(velocity, torch.ones(1, 200, 1), cells, grid)
    mean = momentum / torch.where(count > 0, count, torch.ones_like(count))
    filled = (count > 1e-6).expand_as(mean)
    torch.testing.assert_close(mean[filled], torch.full_like(mean[filled], 0.25), rtol=1e-4, atol=1e-5)
