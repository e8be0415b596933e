import dataclasses

import pytest
import torch
from scenes import box, cloud
from torch import Tensor

from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints, energy
from nmpm.emulator.contact import SURFACE
from nmpm.emulator.crowding import MAX_SHIFT, Crowding
from nmpm.emulator.rollouts import rollout, unroll
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.processors import Pointwise
from nmpm.scene import Scene
from nmpm.transfer import Linear
from nmpm.transfer.linear import linear_g2p


def square(cells: int = 32, dim: int = 2, periodic: bool = False) -> Grid:
    return Grid((cells,) * dim, (0.0,) * dim, (1.0,) * dim, (periodic,) * dim)


def block(side: float, per_axis: int, centre: float = 16.0, dim: int = 2) -> Tensor:
    """A lattice of particles (1, per_axis ** dim, dim) that fills a cube."""
    line = centre + side * ((torch.arange(per_axis) + 0.5) / per_axis - 0.5)
    return torch.stack(torch.meshgrid(*[line] * dim, indexing="ij"), dim=-1).reshape(1, -1, dim)


def crowding(grid: Grid, cap: float = 1.0, particle: float = 0.25, solid: Tensor | None = None) -> Crowding:
    room = torch.ones(1, 1, *grid.shape) if solid is None else 1 - solid
    return Crowding(cap, particle, room, grid)


def everybody(cells: Tensor) -> Tensor:
    return torch.ones_like(cells[..., :1], dtype=torch.bool)


def spread(crowd: Crowding, cells: Tensor, times: int) -> Tensor:
    for _ in range(times):
        shift = crowd.shift(cells, everybody(cells))
        if shift is None:
            return cells
        cells = cells + shift
    return cells


def fullness(crowd: Crowding, cells: Tensor) -> Tensor:
    return Linear().p2g(torch.ones_like(cells[..., :1]), cells, crowd.grid) * (crowd.particle / crowd.cap)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_block_below_the_cap_stays_to_the_bit(dim):
    grid = square(16, dim)
    crowd, even = crowding(grid, cap=1.05, particle=0.5**dim), block(4, 8, centre=8.0, dim=dim)
    assert crowd.shift(even, everybody(even)) is None
    dense = block(2, 8, centre=8.0, dim=dim)
    shift = crowd.shift(torch.cat([even, dense]), everybody(torch.cat([even, dense])))
    assert shift is not None
    assert shift[0].eq(0).all()
    assert shift[1].abs().max() > 0.1


def test_a_compressed_block_expands_to_the_cap_and_no_further():
    crowd, dense = crowding(square()), block(4, 16)  # four times as full as the cap
    assert fullness(crowd, dense).max() == pytest.approx(4, rel=1e-3)
    loose = spread(crowd, dense, 100)
    full = fullness(crowd, loose)
    assert full.max() < 1.05
    occupied = full > 0.5
    assert occupied.sum() < 1.3 * 4 * 16
    assert full[occupied].mean() > 0.8
    assert loose.mean((0, 1)).sub(16).abs().max() < 0.01


def test_shifts_are_mirrored_with_the_scene_and_balanced():
    crowd = crowding(square())
    cells = 16 + 1.5 * torch.randn(1, 100, 2, generator=torch.Generator().manual_seed(1))
    mirrored = torch.stack([32 - cells[..., 0], cells[..., 1]], dim=-1)
    one, other = (crowd.shift(place, everybody(place)) for place in (cells, mirrored))
    torch.testing.assert_close(other * torch.tensor([-1.0, 1.0]), one, rtol=0, atol=1e-4)
    assert one.sum(1).norm() < 0.05 * one.norm(dim=-1).sum()  # away from walls


def test_scenes_do_not_feel_each_other_and_periodic_axes_have_no_ends():
    crowd = crowding(square(periodic=True))
    blocks = torch.cat([block(3, 12, centre=c) for c in (16.0, 0.0, 32.0)])
    shifts = crowd.shift(blocks, everybody(blocks))
    assert torch.equal(shifts[:1], crowd.shift(blocks[:1], everybody(blocks[:1])))
    torch.testing.assert_close(shifts[1:], shifts[:1].expand(2, -1, -1), rtol=0, atol=1e-4)


def test_nobody_moves_more_than_the_largest_shift_and_padding_not_at_all():
    crowd, point = crowding(square()), torch.full((1, 500, 2), 16.3)
    real = (torch.arange(500) < 400).view(1, -1, 1)
    shift = crowd.shift(point, real)
    assert shift.abs().max() <= MAX_SHIFT
    assert shift[:, 400:].eq(0).all()
    assert torch.equal(shift[:, :400], crowd.shift(point[:, :400], real[:, :400]))


def test_no_flow_through_a_solid():
    grid = square()
    solid = torch.zeros(1, 1, *grid.shape)
    solid[..., :16] = 1.0  # below y = 16
    crowd = crowding(grid, solid=solid)
    dense = block(3, 12) + torch.tensor([0.0, 2.0])
    shift = crowd.shift(dense, everybody(dense))
    assert shift.mean((0, 1))[1] > 0.05  # upwards only
    assert spread(crowd, dense, 100)[..., 1].min() >= 15.5


def test_derivatives_are_finite_and_those_of_differences():
    crowd = crowding(square(12))
    cells = 6 + torch.randn(1, 40, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    crowd = dataclasses.replace(crowd, free=crowd.free.double())
    direction = torch.randn(1, 40, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    along = [crowd.shift(cells + sign * 1e-7 * direction, everybody(cells)).square().sum() for sign in (1, -1)]
    leaf = cells.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(crowd.shift(leaf, everybody(cells)).square().sum(), leaf)
    assert gradient.isfinite().all()
    assert (gradient * direction).sum().item() == pytest.approx(((along[0] - along[1]) / 2e-7).item(), rel=1e-4)


def test_the_form_for_other_devices_is_the_same(monkeypatch):
    crowd, dense = crowding(square()), block(3, 12)
    expected = crowd.shift(dense, everybody(dense))
    monkeypatch.setattr("nmpm.emulator.crowding.is_eager_cpu", lambda _: False)
    assert torch.equal(crowd.shift(dense, everybody(dense)), expected)
    loose = block(8, 8)
    assert crowd.shift(loose, everybody(loose)).eq(0).all()


# Rollouts


def emulator_of(scene: Scene, gain: float = 0.0, frames: int = 4, **constraints) -> Emulator:
    torch.manual_seed(0)
    held = Constraints(**constraints)
    cells = 16 if scene.dim == 2 else 8
    emulator = EmulatorRecipe(scene, cells, frames, processor=Pointwise(hidden=(8,)), constraints=held).build().eval()
    emulator.output_scale.mul_(gain)
    return emulator


def crowd_in(scene: Scene, count: int = 400, width: float = 0.1, batch: int = 1, **changes) -> Particles:
    """A cloud in a few cells, at rest."""
    state = cloud(scene, count=count, batch=batch, speed=0.0, **changes)
    return state.with_motion(0.5 + width * (state.position - 0.5) / 0.2, state.velocity)


def peak(emulator: Emulator, position: Tensor) -> float:
    cells = emulator.grid.to_cells(position)
    count = Linear().p2g(torch.ones_like(cells[..., :1]), cells, emulator.grid)
    return float(count.max()) * emulator.scene.particle_volume / emulator.grid.cell_volume


SCENES = {
    "walls": box(gravity=(0.0, 0.0)),
    "two materials": box(gravity=(0.0, 0.0), materials=("water", "sand"), densities=(1000.0, 1600.0)),
    "periodic": box(gravity=(0.0, 0.0), boundary=("periodic", "wall"), domain=((0.1, 0.9), (0.08, 0.92))),
    "obstacles": box(gravity=(0.0, 0.0), obstacles=True),
    "three axes": box(3, gravity=(0.0, 0.0, 0.0), obstacles=True),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_rollout_spreads_what_is_crowded_and_stays_within_bounds(name):
    scene = SCENES[name]
    capped, flat = emulator_of(scene, density_cap=2.0), scene.dim == 2
    count, width = (400, 0.1) if flat else (6000, 0.06)
    state = crowd_in(scene, count, width, statics=5 if scene.obstacles else 0)
    held = rollout(capped, state, 80)
    assert peak(capped, state.position) > 4
    assert peak(capped, held[:, -1]) < 2.2
    low, high = torch.tensor(scene.bounds).T
    for axis, wraps in enumerate(scene.periodic):
        if not wraps:
            assert held[..., axis].min() >= low[axis] - 1e-6
            assert held[..., axis].max() <= high[axis] + 1e-6


def test_the_velocity_is_that_of_the_material_not_of_the_spreading():
    capped, loose = emulator_of(SCENES["walls"], density_cap=2.0), cloud(SCENES["walls"])
    assert torch.equal(rollout(capped, loose, 4), rollout(capped.unconstrained(), loose, 4))
    (bundle,) = unroll(capped, crowd_in(SCENES["walls"]), 1)
    assert bundle.velocity.eq(0).all()
    steps = bundle.position.diff(dim=1)
    assert steps.abs().max() > 1e-4
    torch.testing.assert_close(steps, steps[:, :1].expand_as(steps), rtol=0, atol=1e-6)  # even over the frames


@pytest.mark.parametrize("branching", [True, False])
def test_the_energy_of_no_frame_exceeds_that_of_the_first_state(branching, monkeypatch):
    if not branching:
        for module in ("advection", "crowding"):
            monkeypatch.setattr(f"nmpm.emulator.{module}.is_eager_cpu", lambda _: False)
    scene = box()
    emulator = emulator_of(scene, gain=1.0, energy=True, density_cap=1.0)
    state = crowd_in(scene, batch=2)
    # One scene on the floor, where spreading lifts it, the other in the air, where it costs nothing.
    low = state.position[:1] - torch.tensor([0.0, 0.35])
    state = state.with_motion(torch.cat([low.clamp(min=0.1), state.position[1:]]), state.velocity)
    share = torch.full((2, 400, 1), 1 / 400)
    cells, velocity, gravity = emulator.in_cells(state)
    budget = energy(cells, velocity, gravity, share)
    for bundle in unroll(emulator, state, 10):
        path = emulator.grid.to_cells(bundle.position)
        steps = path.diff(dim=1, prepend=cells.unsqueeze(1))
        assert (energy(path, steps, gravity, share) <= budget.unsqueeze(1) + 1e-5).all()
        cells = path[:, -1]
        end = energy(cells, emulator.grid.to_cell_displacement(bundle.velocity), gravity, share)
        assert (end <= budget + 1e-5).all()


def test_resting_particles_move_only_where_they_are_crowded():
    scene = SCENES["walls"]
    emulator = emulator_of(scene, gain=0.01, density_cap=2.0, rest_speed=0.5)
    state = crowd_in(scene)
    apart = state.position.clone()
    apart[:, :40] = 0.2 + 0.1 * (apart[:, :40] - 0.5) / 0.1  # a few, far from the crowd
    end = rollout(emulator, state.with_motion(apart, state.velocity), 40)[:, -1]
    torch.testing.assert_close(end[:, :40], apart[:, :40], rtol=0, atol=1e-6)
    assert (end[:, 40:] - apart[:, 40:]).abs().max() > 0.01
    again = rollout(emulator, state.with_motion(end, state.velocity), 200)[:, -1]
    final = rollout(emulator, state.with_motion(again, state.velocity), 40)[:, -1]
    assert (final - again).abs().max() < 0.1 * emulator.grid.spacing[0]  # what has spread stays


def test_nobody_is_pushed_into_an_obstacle():
    scene = box(gravity=(0.0, 0.0), obstacles=True)
    emulator = emulator_of(scene, density_cap=1.0)
    x, y = torch.meshgrid(torch.linspace(0.3, 0.7, 40), torch.linspace(0.38, 0.44, 6), indexing="ij")
    floor = torch.stack([x, y], dim=-1).reshape(1, -1, 2)
    state = crowd_in(scene)
    state = dataclasses.replace(state, obstacle=floor, obstacle_mask=torch.ones(floor.shape[:2], dtype=torch.bool))
    place = torch.stack([state.position[..., 0], state.position[..., 1].sub(0.5).abs() * 0.5 + 0.49], dim=-1)
    path = rollout(emulator, state.with_motion(place, state.velocity), 80)
    depth = linear_g2p(emulator.solid(state), emulator.grid.to_cells(path).flatten(1, 2), emulator.grid)
    assert depth.max() <= SURFACE + 1e-3
    assert (path[:, -1, :, 1] > 0.41).all()  # nobody got through


def test_gradients_of_a_capped_rollout_are_finite():
    scene = box()
    emulator = emulator_of(scene, gain=0.1, density_cap=1.5, energy=True)
    state = crowd_in(scene)
    place = state.position.clone().requires_grad_()
    *_, last = unroll(emulator, state.with_motion(place, state.velocity), 3)
    (gradient,) = torch.autograd.grad(last.position.square().sum(), place)
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0


def test_a_cap_that_is_none():
    with pytest.raises(ConfigError, match="density_cap"):
        Constraints(density_cap=float("nan"))
