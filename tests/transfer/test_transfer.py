import subprocess
import sys

import pytest
import torch

from nmpm.grid import Grid
from nmpm.testing import TransferContract
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, gather


class TestNearest(TransferContract):
    transfer = Nearest()
    one_kernel = False


class TestLinear(TransferContract):
    transfer = Linear()


class TestQuadratic(TransferContract):
    transfer = Quadratic()


class TestAffine(TransferContract):
    transfer = Affine()


def test_linear_sampler_equals_its_stencil():
    grid = Grid((11, 17), (0.0, 0.0), (1.0, 1.0), (False, False))
    cells = torch.rand(2, 50, 2, dtype=torch.float64) * 25 - 4
    field = torch.randn(2, 3, 11, 17, dtype=torch.float64)
    by_stencil = gather(Linear().gather_stencil(cells, grid), field.flatten(2).transpose(1, 2))
    torch.testing.assert_close(Linear().g2p(field, cells, grid), by_stencil, rtol=1e-10, atol=1e-10)


EXACT = Affine(damping=0.0)
GRIDS = (
    Grid((9, 14), (0.0, 0.0), (0.1, 0.2), (False, False)),
    Grid((8, 6), (-1.0, 3.0), (1.0, 1.0), (True, False)),
    Grid((5, 7, 6), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (False, True, False)),
)


def particles_all_over(grid: Grid, per_cell: int = 6, materials: int = 2, seed: int = 0):
    """Particles all over a grid, in float64: places, velocities and membership."""
    generator = torch.Generator().manual_seed(seed)
    count = per_cell * grid.size
    cells = torch.rand(2, count, grid.dim, generator=generator, dtype=torch.float64) * torch.tensor(grid.shape)
    velocity = torch.randn(2, count, grid.dim, generator=generator, dtype=torch.float64)
    kind = torch.randint(materials, (2, count), generator=generator)
    return cells, velocity, torch.nn.functional.one_hot(kind, materials).double()


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("transfer", [EXACT, Affine(), Quadratic()])
def test_momentum_and_mass_are_conserved_everywhere(grid, transfer):
    cells, velocity, membership = particles_all_over(grid)
    cells = cells.clone()
    cells[:, :4] = torch.tensor([[0.0], [-1.0], [1e6], [0.5]], dtype=torch.float64)
    momentum, count = transfer.momentum(velocity, membership, cells, grid)
    expected = (membership.unsqueeze(-1) * velocity.unsqueeze(-2)).flatten(-2).sum(1)
    torch.testing.assert_close(momentum.flatten(2).sum(-1), expected, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(count.flatten(2).sum(-1), membership.sum(1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("grid", [GRIDS[0], Grid((5, 7, 6), (0.0,) * 3, (1.0,) * 3, (False,) * 3)])
def test_linear_velocities_arrive_as_they_are(grid):
    cells, _, membership = particles_all_over(grid, per_cell=12)
    slope = torch.randn(grid.dim, grid.dim, dtype=torch.float64)
    momentum, count = EXACT.momentum(cells @ slope.T + 1.5, membership, cells, grid)
    mean = momentum.unflatten(1, (2, grid.dim)) / count.unsqueeze(2)
    axes = [torch.arange(n, dtype=torch.float64) + 0.5 for n in grid.shape]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    wanted = (nodes @ slope.T + 1.5).movedim(-1, 0)[None, None].expand_as(mean)
    inner = (..., *(slice(2, n - 2) for n in grid.shape))  # beyond, weights are folded at the walls
    torch.testing.assert_close(mean[inner], wanted[inner], rtol=1e-8, atol=1e-8)
    plain, count = Quadratic().momentum(cells @ slope.T + 1.5, membership, cells, grid)
    smoothed = plain.unflatten(1, (2, grid.dim)) / count.unsqueeze(2)
    assert (smoothed[inner] - wanted[inner]).abs().max() > 1e-2  # what the gradient mends


def test_a_turning_disc_keeps_its_spin():
    grid = Grid((24, 24), (0.0, 0.0), (1.0, 1.0), (False, False))
    generator = torch.Generator().manual_seed(0)
    place = 24 * torch.rand(1, 6000, 2, generator=generator, dtype=torch.float64)
    place = place[:, ((place[0] - 12).norm(dim=-1) < 4)]
    turning = torch.stack([-(place[..., 1] - 12), place[..., 0] - 12], dim=-1)
    one = torch.ones(1, place.shape[1], 1, dtype=torch.float64)
    centres = torch.arange(24, dtype=torch.float64) + 0.5 - 12
    x, y = torch.meshgrid(centres, centres, indexing="ij")

    def spin(transfer):
        momentum, _ = transfer.momentum(turning, one, place, grid)
        return (x * momentum[0, 1] - y * momentum[0, 0]).sum()

    truth = (place - 12).square().sum()
    # A quadratic kernel spreads each particle by a quarter of a cell² per axis, which a turning disc then carries.
    spread = truth + 2 * 0.25 * place.shape[1]
    assert spin(Affine()) == pytest.approx(spread.item(), rel=2e-3)
    assert spin(Quadratic()) == pytest.approx(truth.item(), rel=1e-9)


def test_gradients_are_right():
    grid = Grid((4, 5), (0.0, 0.0), (1.0, 1.0), (False, True))
    cells = 0.6 + 2.7 * torch.rand(1, 5, 2, dtype=torch.float64)
    velocity = torch.randn(1, 5, 2, dtype=torch.float64, requires_grad=True)
    cells.requires_grad_()
    one = torch.ones(1, 5, 1, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda v, c: Affine().momentum(v, one, c, grid)[0], (velocity, cells))


@pytest.mark.slow
def test_gradients_at_places_that_are_no_numbers_do_not_end_the_process():
    """Torch's sampler crashes there on a CPU, so another process tries it."""
    program = """
import torch
from nmpm.grid import Grid
from nmpm.transfer import Linear
field = torch.randn(2, 2, 64, 64).to(memory_format=torch.channels_last).requires_grad_()
cells = 64 * torch.rand(2, 1800, 2)
cells[0, ::3], cells[1, ::5] = float("nan"), float("inf")
Linear().g2p(field, cells.requires_grad_(), Grid((64, 64), (0.0, 0.0), (1.0, 1.0), (False, False))).sum().backward()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
