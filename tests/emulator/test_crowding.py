"""Crowded particles spread into the free volume around them, in closed forms and in rollouts."""

import dataclasses

import pytest
import torch
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.emulator.engines.torch.contact import SURFACE
from nmpm.emulator.engines.torch.crowding import MAX_SHIFT, Crowding
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.grid import Grid
from nmpm.particles import Particles, lattice
from nmpm.scene import Scene
from nmpm.transfer import Linear, linear_g2p
from tests.scenes import CHANNEL, box, cloud, emulator_of, with_obstacle


def square(cells: int = 32, dim: int = 2, periodic: bool = False) -> Grid:
    return Grid((cells,) * dim, (0.0,) * dim, (1.0,) * dim, (periodic,) * dim)


def block(side: float, per_axis: int, centre: float = 16.0, dim: int = 2) -> Tensor:
    """A lattice of particles (1, per_axis ** dim, dim) that fills a cube."""
    line = centre + side * ((torch.arange(per_axis) + 0.5) / per_axis - 0.5)
    return torch.stack(torch.meshgrid(*[line] * dim, indexing="ij"), dim=-1).reshape(1, -1, dim)


def crowding(grid: Grid, cap: float = 1.0, particle: float = 0.25, solid: Tensor | None = None) -> Crowding:
    room = torch.ones(1, 1, *grid.shape) if solid is None else 1 - solid
    return Crowding(cap, particle, room, grid)


def shifted(crowd: Crowding, cells: Tensor) -> Tensor:
    """How far each particle is moved."""
    shift = crowd.shift(cells, torch.ones_like(cells[..., :1], dtype=torch.bool))
    return torch.zeros_like(cells) if shift is None else shift


def spread(crowd: Crowding, cells: Tensor) -> Tensor:
    """Where particles are after a hundred shifts."""
    for _ in range(100):
        cells = cells + shifted(crowd, cells)
    return cells


def fullness(cells: Tensor, grid: Grid, particle: float) -> Tensor:
    return Linear().p2g(torch.ones_like(cells[..., :1]), cells, grid) * particle


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("branching", [True, False])
def test_a_block_below_the_cap_stays_to_the_bit(dim, branching, monkeypatch):
    crowd, even = crowding(square(16, dim), cap=1.05, particle=0.5**dim), block(4, 8, centre=8.0, dim=dim)
    both = torch.cat([even, block(2, 8, centre=8.0, dim=dim)])
    expected = shifted(crowd, both)
    if not branching:
        monkeypatch.setattr("nmpm.emulator.engines.torch.crowding.is_eager_cpu", lambda _: False)
    assert shifted(crowd, even).eq(0).all()
    shift = shifted(crowd, both)
    assert torch.equal(shift, expected)
    assert shift[0].eq(0).all()
    assert shift[1].abs().max() > 0.1


def test_a_compressed_block_expands_to_the_cap_and_no_further():
    crowd, dense = crowding(square()), block(4, 16)  # four times as full as the cap
    loose = spread(crowd, dense)
    full = fullness(loose, crowd.grid, crowd.particle)
    assert full.max() < 1.05
    occupied = full > 0.5
    assert occupied.sum() < 1.3 * 4 * 16
    assert full[occupied].mean() > 0.8
    assert loose.mean((0, 1)).sub(16).abs().max() < 0.01


def test_scenes_do_not_feel_each_other_and_periodic_axes_have_no_ends():
    crowd = crowding(square(periodic=True))
    blocks = torch.cat([block(3, 12, centre=c) for c in (16.0, 0.0, 32.0)])
    shifts = shifted(crowd, blocks)
    assert torch.equal(shifts[:1], shifted(crowd, blocks[:1]))
    torch.testing.assert_close(shifts[1:], shifts[:1].expand(2, -1, -1), rtol=0, atol=1e-4)


def test_nobody_moves_more_than_the_largest_shift_and_padding_not_at_all():
    crowd, point = crowding(square()), torch.full((1, 500, 2), 16.3)
    real = (torch.arange(500) < 400).view(1, -1, 1)
    shift = crowd.shift(point, real)
    assert shift.abs().max() <= MAX_SHIFT
    assert shift[:, 400:].eq(0).all()
    assert torch.equal(shift[:, :400], crowd.shift(point[:, :400], real[:, :400]))


def test_no_flow_through_a_solid():
    solid = torch.zeros(1, 1, 32, 32)
    solid[..., :16] = 1.0  # below y = 16
    crowd, dense = crowding(square(), solid=solid), block(3, 12) + torch.tensor([0.0, 2.0])
    assert shifted(crowd, dense).mean((0, 1))[1] > 0.05  # upwards only
    assert spread(crowd, dense)[..., 1].min() >= 15.5


def test_derivatives_are_those_of_differences():
    generator = torch.Generator().manual_seed(3)
    crowd = crowding(square(12))
    crowd = dataclasses.replace(crowd, free=crowd.free.double())
    cells = 6 + torch.randn(1, 40, 2, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c: shifted(crowd, c), cells.requires_grad_(), eps=1e-7, fast_mode=True)


# Rollouts


def crowd_in(scene: Scene, count: int = 400, width: float = 0.1, **changes) -> Particles:
    """A cloud in a few cells, at rest."""
    state = cloud(scene, count, speed=0.0, **changes)
    return state.with_motion(0.5 + width * (state.position - 0.5) / 0.2, state.velocity)


def peak(emulator: Emulator, position: Tensor) -> float:
    particle = emulator.scene.particle_volume / emulator.grid.cell_volume
    return float(fullness(emulator.grid.to_cells(position), emulator.grid, particle).max())


SCENES = {
    "two materials": box(gravity=(0.0, 0.0), materials=("water", "sand"), densities=(1000.0, 1600.0)),
    "channel with obstacles": box(gravity=(0.0, 0.0), obstacles=True, **CHANNEL),
    "three axes": box(3, gravity=(0.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_rollout_spreads_what_is_crowded_and_stays_within_bounds(name):
    scene = SCENES[name]
    cells, count, width, frames = (16, 400, 0.1, 80) if scene.dim == 2 else (8, 5000, 0.06, 40)
    capped = emulator_of(scene, cells, scale=0.0, density_cap=2.0)
    state = crowd_in(scene, count, width, statics=5 if scene.obstacles else 0)
    held = rollout(capped, state, frames)
    assert peak(capped, state.position) > 4
    assert peak(capped, held[:, -1]) < 2.2
    for axis, (low, high) in enumerate(scene.bounds):
        if not scene.periodic[axis]:
            assert held[..., axis].min() >= low - 1e-6
            assert held[..., axis].max() <= high + 1e-6


def test_the_velocity_is_that_of_the_material_not_of_the_spreading():
    scene = box(gravity=(0.0, 0.0))
    capped, loose = emulator_of(scene, scale=0.0, density_cap=2.0), cloud(scene)
    assert torch.equal(rollout(capped, loose, 4), rollout(capped.unconstrained(), loose, 4))
    (bundle,) = unroll(capped, crowd_in(scene), 1)
    assert bundle.velocity.eq(0).all()
    steps = bundle.position.diff(dim=1)
    assert steps.abs().max() > 1e-4
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps), rtol=0, atol=1e-6)  # even over the frames


def test_resting_particles_move_only_where_they_are_crowded():
    scene = box(gravity=(0.0, 0.0))
    emulator, state = emulator_of(scene, scale=0.01, density_cap=2.0, rest_speed=0.5), crowd_in(scene)
    apart = state.position.clone()
    apart[:, :40] -= 0.3  # a few, far from the crowd
    path = rollout(emulator, state.with_motion(apart, state.velocity), 240)
    torch.testing.assert_close(path[:, -1, :40], apart[:, :40], rtol=0, atol=1e-6)
    assert (path[:, -1, 40:] - apart[:, 40:]).abs().max() > 0.01
    assert (path[:, -1] - path[:, -40]).abs().max() < 0.1 * emulator.grid.spacing[0]  # what has spread stays


def test_nobody_is_pushed_into_an_obstacle():
    scene = box(gravity=(0.0, 0.0), obstacles=True)
    emulator = emulator_of(scene, scale=0.0, density_cap=1.0)
    state = with_obstacle(crowd_in(scene), lattice(((0.3, 0.7), (0.38, 0.44)), 0.01))
    above = torch.stack([state.position[..., 0], state.position[..., 1].sub(0.5).abs() * 0.5 + 0.49], dim=-1)
    path = rollout(emulator, state.with_motion(above, state.velocity), 80)
    depth = linear_g2p(emulator.solid(state), emulator.grid.to_cells(path).flatten(1, 2), emulator.grid)
    assert depth.max() <= SURFACE + 1e-3
    assert (path[:, -1, :, 1] > 0.41).all()  # nobody got through
