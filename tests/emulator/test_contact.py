"""Particles do not enter obstacles: closed forms, a rollout."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.emulator.engines.torch.contact import SURFACE, Contact
from nmpm.emulator.rollouts import rollout
from nmpm.grid import Grid
from nmpm.particles import lattice
from tests.scenes import box, cloud, emulator_of, with_obstacle

GRID = Grid((20, 20), (0.0, 0.0), (1.0, 1.0), (False, False))
TOP = 10.5 - SURFACE
"""Surface of `floor()`, interpolated between the nodes at 9.5 (solid) and 10.5 (free)."""


def floor() -> Contact:
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 7:10] = 1.0
    return Contact(solid, GRID)


def wall(offset: float = 0.3) -> Contact:
    """A wall of one cell across the domain, its lower face at 8 + offset."""
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 8], solid[..., 9] = 1 - offset, offset
    return Contact(solid, GRID)


def block() -> Contact:
    """An obstacle with corners."""
    solid = torch.zeros(1, 1, 20, 20)
    solid[..., 7:12, 5:9] = 1.0
    return Contact(solid, GRID)


def straight(start: list[float], step: list[float], frames: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    begin = torch.tensor([[start]])
    return begin, begin.unsqueeze(1) + torch.arange(1, frames + 1)[:, None, None] * torch.tensor(step)


def jumble(batch: int = 1, frames: int = 4, speed: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Start and path of 50 particles in each scene that move to and fro, some of them from inside of obstacles."""
    generator = torch.Generator().manual_seed(0)
    start = 20 * torch.rand(batch, 50, 2, generator=generator)
    steps = speed * torch.randn(batch, frames, 50, 2, generator=generator)
    return start, start.unsqueeze(1) + steps.cumsum(1)


def test_a_fall_onto_the_floor_ends_at_its_surface():
    begin, path = straight([5.0, 12.0], [0.0, -0.7])
    held = floor().hold(begin, path)
    assert TOP - 1e-5 <= held[0, -1, 0, 1] <= TOP + 0.5
    assert held[0, :, 0, 0].tolist() == pytest.approx([5.0] * 4)
    assert torch.equal(held[:, :2], path[:, :2])  # until it touches


def test_what_comes_at_a_slant_slides_along():
    held = floor().hold(*straight([5.0, 10.6], [0.5, -0.5]))
    assert held[0, -1, 0, 0].item() == pytest.approx(7.0, abs=0.3)
    assert held[0, :, 0, 1].min() >= TOP - 1e-5


def test_what_is_inside_is_pushed_out():
    held = floor().hold(*straight([5.0, 9.6], [0.0, 0.0]))
    assert held[0, -1, 0, 1].item() >= TOP - 1e-5
    assert (held[0, :, 0, 1].diff() >= 0).all()


def test_in_three_dimensions():
    grid, solid = Grid((8, 8, 8), (0.0,) * 3, (1.0,) * 3, (False,) * 3), torch.zeros(1, 1, 8, 8, 8)
    solid[:, :, :, :4] = 1.0
    held = Contact(solid, grid).hold(*straight([4.0, 6.0, 4.0], [0.1, -1.3, 0.2]))
    assert held[0, :, 0, 1].min() >= 4.5 - SURFACE - 1e-5
    assert held[0, -1, 0, 2] > 4.3


@given(
    speed=st.floats(0.01, 12), angle=st.floats(-3.1, 3.1), x=st.floats(1, 19), y=st.floats(10.6, 19),
    offset=st.floats(0, 1),
)  # fmt: skip
@settings(max_examples=30)
def test_nobody_gets_through_one_cell_however_it_lies_and_however_fast(speed, angle, x, y, offset):
    direction = torch.tensor([angle]).cos().item(), torch.tensor([angle]).sin().item()
    held = wall(offset).hold(*straight([x, y], [speed * direction[0], speed * direction[1]], frames=8))
    assert held.isfinite().all()
    assert (held[..., 1] > 8 + offset).all()


@pytest.fixture(params=["values are read", "no values are read"])
def device(request, monkeypatch):
    """As on a CPU, and as on a GPU."""
    if request.param.startswith("no"):
        monkeypatch.setattr("nmpm.emulator.engines.torch.contact.is_eager_cpu", lambda _: False)


@pytest.mark.parametrize("obstacle", [floor, wall, block])
@pytest.mark.parametrize("speed", [0.0, 0.9, 32.0])
def test_scenes_are_held_as_alone_and_without_reading_values_back(obstacle, speed, monkeypatch):
    one, (start, jitter) = obstacle(), jumble(3, 6, 0.1 * speed)
    contact = Contact(torch.cat([one.solid, torch.zeros_like(one.solid), one.solid]), GRID)
    ahead = torch.nn.functional.normalize(start - start.mean(1, keepdim=True), dim=-1).unsqueeze(1)
    path = jitter + speed * torch.arange(1, 7).view(1, -1, 1, 1) * ahead
    path[2] = start[2] + 0.01 * (path[2] - start[2])  # a scene of its own speed
    held = contact.hold(start, path)
    assert not torch.equal(held, path)
    assert torch.equal(held[1], path[1])
    torch.testing.assert_close(held[2:], one.hold(start[2:], path[2:]))  # whatever others' speed
    assert contact.hold(start[:, :0], path[:, :, :0]).shape == path[:, :, :0].shape
    monkeypatch.setattr("nmpm.emulator.engines.torch.contact.is_eager_cpu", lambda _: False)
    torch.testing.assert_close(contact.hold(start, path), held, rtol=0, atol=1e-5)


def test_in_chunks_it_is_the_same(monkeypatch):
    start, path = jumble()
    whole = block().hold(start, path)
    in_sevens = lambda count, *_, **__: [slice(i, i + 7) for i in range(0, count, 7)]  # noqa: E731
    monkeypatch.setattr("nmpm.emulator.engines.torch.contact.chunks", in_sevens)
    torch.testing.assert_close(block().hold(start, path), whole, rtol=0, atol=1e-5)


@pytest.mark.usefixtures("device")
def test_padding_is_left_as_it_is_and_changes_no_other_path():
    start, path = jumble(2, speed=0.4)
    path[:, :, 40:] = start[:, None, 40:] + 20 * (path[:, :, 40:] - start[:, None, 40:])  # fast, some inside
    mask = torch.arange(50).expand(2, -1) < 40
    contact = Contact(block().solid.repeat(2, 1, 1, 1), GRID)
    held = contact.hold(start, path, mask)
    assert torch.equal(held[:, :, :40], contact.hold(start[:, :40], path[:, :, :40]))
    assert torch.equal(held[:, :, 40:], path[:, :, 40:])
    assert not torch.equal(held, path)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_step_that_is_not_finite_stays_so_and_disturbs_nobody(value):
    begin, path = straight([5.0, 12.0], [0.0, -0.7])
    broken = path.clone()
    broken[0, 2:, 0, 1] = value
    held = floor().hold(begin.repeat(1, 2, 1), torch.cat([path, broken], dim=2))
    torch.testing.assert_close(held[:, :, :1], floor().hold(begin, path))
    assert not held[:, 2:, 1].isfinite().all()


@pytest.mark.parametrize("solids", [True, False])
def test_a_rollout_does_not_sink_into_an_obstacle(solids):
    scene = box(obstacles=True, particle_volume=0.01**2)
    emulator = emulator_of(scene, 32, scale=1e-3, solids=solids)
    state = with_obstacle(cloud(scene), lattice(((0.08, 0.92), (0.1, 0.2)), 0.01))
    lowest = rollout(emulator, state, 160)[..., 1].min()
    assert lowest > 0.19 if solids else lowest < 0.12
