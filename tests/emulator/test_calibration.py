"""Statistics from training data, what they say of gravity, and volumes on the grid."""

import dataclasses

import pytest
import torch

from nmpm.decoders import Absolute
from nmpm.emulator.calibration import (
    calibrate,
    calibrated_range,
    density_cap,
    gravity_range,
    usual_gravity,
    with_usual_gravity,
)
from nmpm.emulator.rasterise import grid_state, volume_fraction
from nmpm.grid import Grid
from nmpm.transfer import Linear
from tests.scenes import box, cloud, emulator_of, set_gravity_statistics, window_of


def turned(dim=2):
    """An emulator of scenes in which gravity of 10 length/s² points to either side of down, calibrated up to 12."""
    emulator, rest = emulator_of(box(dim, gravity=None, gravity_varies=True), cells=14), [0.0] * (dim - 2)
    usual = {"input_mean": [0, -8, *rest], "input_std": [6, 0, *rest]}
    set_gravity_statistics(emulator, **usual, input_low=[-12] * dim, input_high=[12] * dim)
    return emulator


@pytest.mark.parametrize("dim", [2, 3])
def test_the_usual_gravity_is_the_root_mean_square_downwards(dim):
    emulator, expected = turned(dim), torch.tensor([0.0, -10.0] + [0.0] * (dim - 2))
    torch.testing.assert_close(usual_gravity(emulator), expected.double(), rtol=1e-5, atol=1e-6)
    state = with_usual_gravity(emulator, cloud(emulator.scene, batch=3))
    torch.testing.assert_close(state.gravity / 0.0025**2, expected.expand(3, dim), rtol=1e-5, atol=1e-4)
    known = cloud(box(dim))
    assert with_usual_gravity(emulator_of(box(dim), cells=14), known) is known


def test_ranges_are_in_the_units_of_the_data():
    low, high = gravity_range(turned())
    torch.testing.assert_close(low, torch.tensor([-12.0, -12.0]).double())
    torch.testing.assert_close(high, -low)
    low, high = calibrated_range(turned(), "goop.velocity_")
    assert low.isneginf().all()
    assert high.isposinf().all()


def test_calibration_measures_what_the_network_has_to_give():
    particles = cloud(box(gravity=None), count=50, batch=4)
    steps = 0.002 + 0.001 * torch.randn(4, 6, 50, 2, generator=torch.Generator().manual_seed(1))
    window = window_of(particles, particles.position[:, None] + steps.cumsum(1))
    emulator = emulator_of(box(gravity=None), decoder=Absolute(), frames=3)
    calibrate(emulator, [window])
    expected = emulator.grid.to_cell_displacement(steps[:, 2:]).square().mean((0, 1, 2)).sqrt()
    torch.testing.assert_close(emulator.output_scale.squeeze().mean(0), expected, rtol=0.05, atol=0)
    assert emulator.calibrated
    start = window.initial
    cells, velocity, _ = emulator.in_cells(start)
    state = grid_state(emulator.scene, emulator.grid, Linear(), start, cells, velocity, emulator.solid(start))
    assert (state > emulator.input_low).all()
    assert (state < emulator.input_high).all()
    normalised = (state - emulator.input_mean) / emulator.input_std
    assert normalised.mean((0, 2, 3)).abs().max() < 1e-4
    with pytest.raises(ValueError, match="at least 5 frames"):
        calibrate(emulator, [window.first(4)])


def test_a_material_that_the_calibration_does_not_see_gets_the_scales_of_the_others():
    scene = box(gravity=None, materials=("water", "sand", "goop"))
    particles = cloud(scene, count=60, batch=4)
    particles = dataclasses.replace(particles, material=torch.arange(60).expand(4, -1) % 2 * 2)  # no sand
    emulator, steps = emulator_of(scene), 0.002 * torch.randn(4, 7, 60, 2)
    with pytest.warns(UserWarning, match="no particles of sand"):
        calibrate(emulator, [window_of(particles, particles.position[:, None] + steps.cumsum(1))])
    scale = emulator.output_scale.squeeze().unflatten(-1, (3, 2))
    torch.testing.assert_close(scale[:, 1].square(), (scale[:, 0].square() + scale[:, 2].square()) / 2)
    for figures in (emulator.input_mean.flatten(), emulator.input_std.flatten()):
        velocity, volume = figures[:6].view(3, 2), figures[6:9]
        torch.testing.assert_close(velocity[1], velocity[[0, 2]].mean(0))
        torch.testing.assert_close(volume[1], volume[[0, 2]].mean())


def test_the_density_cap_is_measured_in_windows():
    scene = box(gravity=(0.0, 0.0))
    state, line = cloud(scene, 1600), 0.3 + 0.4 * (torch.arange(40) + 0.5) / 40
    window = window_of(state, torch.cartesian_prod(line, line).expand(1, 6, -1, -1))
    expected = 1600 * scene.particle_volume / 0.4**2
    assert density_cap(emulator_of(scene), [window]) == pytest.approx(expected, rel=0.05)
    with pytest.raises(ValueError, match="half full"):
        density_cap(emulator_of(scene), [dataclasses.replace(window, mask=torch.zeros_like(window.mask))])


def test_walls_fill_the_share_of_the_domain_beyond_the_bounds():
    solid = emulator_of(box(), cells=64).solid(cloud(box()))
    assert solid.mean().item() == pytest.approx(1 - (0.8 / 0.84) ** 2, rel=1e-5)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_volume_fractions_hold_the_volume_of_real_particles(dim):
    scene = box(dim=dim)
    grid, particles = Grid.of(scene, 16), cloud(scene, count=7, batch=2)
    mask = torch.arange(7) < torch.tensor([[7], [3]])
    fraction = volume_fraction(scene, grid, Linear(), mask, grid.to_cells(particles.position))
    assert fraction.shape == (2, 1, *grid.shape)
    volume = fraction.flatten(1).sum(1) * grid.cell_volume
    torch.testing.assert_close(volume, torch.tensor([7.0, 3.0]) * scene.particle_volume)
