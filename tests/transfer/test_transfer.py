import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

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


@pytest.mark.slow
@pytest.mark.parametrize("transfer", [Nearest(), Linear(), Quadratic()])
@settings(max_examples=30, deadline=None)
@given(
    shape=st.lists(st.integers(1, 9), min_size=1, max_size=3),
    periodic=st.lists(st.booleans(), min_size=3, max_size=3),
    count=st.integers(0, 6),
    reach=st.sampled_from([0.3, 1.0, 3.0, 1e4]),
    seed=st.integers(0, 2**16),
)
def test_any_grid_conserves_mass_and_keeps_constants(transfer, shape, periodic, count, reach, seed):
    grid = Grid(tuple(shape), (0.0,) * len(shape), (1.0,) * len(shape), tuple(periodic[: len(shape)]))
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randn(1, count, len(shape), generator=generator, dtype=torch.float64) * reach
    mass = transfer.p2g(torch.ones(1, count, 1, dtype=torch.float64), cells, grid)
    assert mass.sum().item() == pytest.approx(count, abs=1e-9)
    assert (mass >= -1e-12).all()
    gathered = transfer.g2p(torch.ones(1, 1, *shape, dtype=torch.float64), cells, grid)
    torch.testing.assert_close(gathered, torch.ones_like(gathered), rtol=1e-9, atol=1e-9)


def test_linear_sampler_equals_its_stencil():
    grid = Grid((11, 17), (0.0, 0.0), (1.0, 1.0), (False, False))
    cells = torch.rand(2, 50, 2, dtype=torch.float64) * 25 - 4
    field = torch.randn(2, 3, 11, 17, dtype=torch.float64)
    by_stencil = gather(Linear().gather_stencil(cells, grid), field.flatten(2).transpose(1, 2))
    torch.testing.assert_close(Linear().g2p(field, cells, grid), by_stencil, rtol=1e-10, atol=1e-10)
