import pytest
import torch
from scenes import box, cloud

from nmpm.emulator.rasterise import volume_fraction
from nmpm.grid import Grid
from nmpm.transfer import Linear


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_volume_fractions_hold_the_volume_of_real_particles(dim):
    scene = box(dim=dim)
    grid, particles = Grid.of(scene, 16), cloud(scene, count=7, batch=2)
    mask = torch.arange(7) < torch.tensor([[7], [3]])
    fraction = volume_fraction(scene, grid, Linear(), mask, grid.to_cells(particles.position))
    assert fraction.shape == (2, 1, *grid.shape)
    volume = fraction.flatten(1).sum(1) * grid.cell_volume
    torch.testing.assert_close(volume, torch.tensor([7.0, 3.0]) * scene.particle_volume)
