import pytest
import torch
from scenes import box

from nmpm.errors import ConfigError
from nmpm.grid import Grid


def test_cells_are_exactly_extent_over_number():
    grid = Grid.of(box(), 64)
    assert grid.shape == (64, 64)
    assert grid.spacing[0] == (0.92 - 0.08) / 64
    assert grid.centres(0)[0].item() == pytest.approx(0.08 + grid.spacing[0] / 2, abs=1e-15)
    assert grid.centres(0)[-1].item() == pytest.approx(0.92 - grid.spacing[0] / 2, abs=1e-15)


def test_the_other_axes_follow_the_longest():
    wide = box(bounds=((0.0, 2.0), (0.0, 1.0)), domain=((0.0, 2.0), (0.0, 1.0)))
    assert Grid.of(wide, 128).shape == (128, 64)
    assert Grid.of(wide, [100, 30]).shape == (100, 30)


@pytest.mark.parametrize("cells", [0, -3, [64], [64, 0], [8, 8, 8]])
def test_impossible_grids_are_refused(cells):
    with pytest.raises(ConfigError, match="does not fit"):
        Grid.of(box(), cells)


def test_float64_positions_far_from_the_origin_keep_their_digits():
    far = box(bounds=((1e8, 1e8 + 1),) * 2, domain=((1e8, 1e8 + 1),) * 2)
    grid = Grid.of(far, 10)
    cells = grid.to_cells(torch.tensor([1e8 + 0.25, 1e8 + 0.5], dtype=torch.float64))
    torch.testing.assert_close(cells, torch.tensor([2.5, 5.0]), atol=1e-6, rtol=0)


def test_lengths_and_cells_are_inverse():
    grid = Grid.of(box(), [20, 31])
    position = torch.rand(3, 5, 2, dtype=torch.float64)
    torch.testing.assert_close(grid.to_length(grid.to_cells(position).double()), position, atol=1e-6, rtol=0)
