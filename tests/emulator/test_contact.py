import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.data.initial_states import lattice
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.contact import SURFACE, Contact
from nmpm.emulator.rollouts import rollout
from nmpm.grid import Grid
from nmpm.processors import Pointwise

GRID = Grid((20, 20), (0.0, 0.0), (1.0, 1.0), (False, False))


def floor(top: int = 10, thick: int = 3) -> Contact:
    """A slab whose upper face is at y = top."""
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., top - thick : top] = 1.0
    return Contact(solid, GRID)


def straight(start: list[float], step: list[float], frames: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    begin = torch.tensor([[start]])
    return begin, begin.unsqueeze(1) + torch.arange(1, frames + 1)[:, None, None] * torch.tensor(step)


def test_a_fall_onto_the_floor_ends_at_its_surface():
    begin, path = straight([5.0, 12.0], [0.0, -0.7])
    held = floor().hold(begin, path)
    # Interpolated between the nodes at 9.5 (solid) and 10.5 (free): the surface is at 10.5 - SURFACE.
    assert held[0, -1, 0, 1].item() == pytest.approx(10.5 - SURFACE, abs=0.5)
    assert held[0, -1, 0, 1] >= 10.5 - SURFACE - 1e-5
    assert held[0, :, 0, 0].tolist() == pytest.approx([5.0] * 4)
    assert torch.equal(held[:, :2], path[:, :2])  # until it touches


def test_what_comes_at_a_slant_slides_along():
    begin, path = straight([5.0, 10.6], [0.5, -0.5])
    held = floor().hold(begin, path)
    assert held[0, -1, 0, 0].item() == pytest.approx(7.0, abs=0.3)
    assert held[0, :, 0, 1].min() >= 10.5 - SURFACE - 1e-5


def test_what_is_inside_is_pushed_out():
    begin, path = straight([5.0, 9.6], [0.0, 0.0])
    held = floor().hold(begin, path)
    assert held[0, -1, 0, 1].item() > 10.5 - SURFACE
    assert (held[0, :, 0, 1].diff() >= 0).all()


@given(
    speed=st.floats(0.01, 12), angle=st.floats(-3.1, 3.1), x=st.floats(1, 19), y=st.floats(10.6, 19),
    offset=st.floats(0, 1),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_nobody_gets_through_one_cell_however_it_lies_and_however_fast(speed, angle, x, y, offset):
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 8], solid[..., 9] = 1 - offset, offset  # a wall of one cell, its lower face at 8 + offset
    direction = torch.tensor([angle]).cos().item(), torch.tensor([angle]).sin().item()
    begin, path = straight([x, y], [speed * direction[0], speed * direction[1]], frames=8)
    held = Contact(solid, GRID).hold(begin, path)
    assert held.isfinite().all()
    assert (held[..., 1] > 8 + offset).all()


def wall(offset: float = 0.3) -> Contact:
    """A wall of one cell across the domain."""
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 8], solid[..., 9] = 1 - offset, offset
    return Contact(solid, GRID)


def block() -> Contact:
    """An obstacle with corners."""
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 7:12, 5:9] = 1.0
    return Contact(solid, GRID)


@pytest.mark.parametrize("obstacle", [floor, wall, block])
@pytest.mark.parametrize("speed", [0.0, 0.9, 32.0])
def test_both_forms_agree(obstacle, speed):
    generator = torch.Generator().manual_seed(int(10 * speed))
    one = obstacle()
    contact = Contact(torch.cat([one.solid, torch.zeros_like(one.solid), one.solid]), GRID)
    start = 20 * torch.rand(3, 50, 2, generator=generator)  # some of them inside
    direction = torch.nn.functional.normalize(torch.randn(3, 1, 50, 2, generator=generator), dim=-1)
    jitter = 0.1 * torch.randn(3, 6, 50, 2, generator=generator)
    path = start.unsqueeze(1) + (speed * (direction + jitter)).cumsum(1)
    path[2] = start[2] + 0.01 * (path[2] - start[2])  # a scene of its own speed
    by_branching, dense = contact.hold_touching(start, path), contact.hold_all(start, path)
    assert not torch.equal(dense, path)
    torch.testing.assert_close(dense, by_branching, rtol=0, atol=2e-4)
    assert torch.equal(dense[1], path[1])
    torch.testing.assert_close(by_branching[2:], one.hold_touching(start[2:], path[2:]))  # whatever others' speed
    assert contact.hold_all(start[:, :0], path[:, :, :0]).shape == path[:, :, :0].shape


def test_the_dense_form_in_chunks_is_the_same(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    start = 20 * torch.rand(1, 50, 2, generator=generator)
    path = start.unsqueeze(1) + torch.randn(1, 4, 50, 2, generator=generator).cumsum(1)
    whole = block().hold_all(start, path)
    in_sevens = lambda count, device, values=1: [slice(i, i + 7) for i in range(0, count, 7)]  # noqa: E731
    monkeypatch.setattr("nmpm.emulator.contact.chunks", in_sevens)
    torch.testing.assert_close(block().hold_all(start, path), whole, rtol=0, atol=1e-5)


@pytest.mark.parametrize("hold", ["hold_touching", "hold_all"])
def test_padding_is_left_as_it_is_and_changes_no_other_path(hold):
    generator = torch.Generator().manual_seed(0)
    start = 20 * torch.rand(2, 50, 2, generator=generator)
    path = start.unsqueeze(1) + (0.4 * torch.randn(2, 4, 50, 2, generator=generator)).cumsum(1)
    path[:, :, 40:] = start[:, None, 40:] + 9 * torch.randn(2, 4, 10, 2, generator=generator)  # fast, some inside
    mask = torch.arange(50).expand(2, -1) < 40
    contact = Contact(block().solid.repeat(2, 1, 1, 1), GRID)
    held = getattr(contact, hold)(start, path, mask)
    assert torch.equal(held[:, :, :40], getattr(contact, hold)(start[:, :40], path[:, :, :40]))
    assert torch.equal(held[:, :, 40:], path[:, :, 40:])
    assert not torch.equal(held, path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("hold", ["hold_touching", "hold_all"])
def test_a_step_that_is_not_finite_stays_so_and_disturbs_nobody(value, hold):
    begin, path = straight([5.0, 12.0], [0.0, -0.7])
    broken = path.clone()
    broken[0, 2:, 0, 1] = value
    held = getattr(floor(), hold)(begin.repeat(1, 2, 1), torch.cat([path, broken], dim=2))
    torch.testing.assert_close(held[:, :, :1], getattr(floor(), hold)(begin, path))
    assert not held[:, 2:, 1].isfinite().all()


def test_in_three_dimensions():
    grid = Grid((8, 8, 8), (0.0,) * 3, (1.0,) * 3, (False,) * 3)
    solid = torch.zeros(1, 1, 8, 8, 8)
    solid[:, :, :, :4] = 1.0
    begin, path = straight([4.0, 6.0, 4.0], [0.1, -1.3, 0.2])
    held = Contact(solid, grid).hold(begin, path)
    assert held[0, :, 0, 1].min() >= 4.5 - SURFACE - 1e-5
    assert held[0, -1, 0, 2] > 4.3


def falling(solids: bool) -> torch.Tensor:
    """Lowest particle, after a block fell onto a slab, under a network that knows nothing."""
    scene = box(obstacles=True, particle_volume=0.01**2)
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene, 32, 4, processor=Pointwise(), constraints=Constraints(solids=solids))
    emulator = recipe.build().eval()
    emulator.output_scale.fill_(1e-3)
    slab = lattice(((0.08, 0.92), (0.1, 0.2)), 0.01)[None]
    mask = torch.ones(1, slab.shape[1], dtype=torch.bool)
    return rollout(emulator, dataclasses.replace(cloud(scene), obstacle=slab, obstacle_mask=mask), 200)[..., 1].min()


def test_a_rollout_does_not_sink_into_an_obstacle():
    assert falling(solids=False) < 0.12
    assert falling(solids=True) > 0.19
