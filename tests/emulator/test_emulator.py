import dataclasses

import pytest
import torch

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import stream_rollout
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError
from nmpm.processors import UNet
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, without_kernels
from tests.scenes import box, cloud, emulator_of, silenced

SMALL = UNet(width=4, depth=1, perceptron=(4,))
TRANSFERS = (Nearest(), Linear(), Quadratic(), Affine())
DECODERS = (Absolute(), Residual(), Flip(), Blend(), Acceleration())
CASES = [(t, Residual()) for t in TRANSFERS] + [(Linear(), d) for d in DECODERS]


def small(scene, transfer=Linear(), decoder=Residual(), cells=16, frames=3):
    return emulator_of(scene, cells, frames, transfer, SMALL, decoder)


@pytest.mark.parametrize("transfer", [Linear(), Quadratic(), Affine()])
@pytest.mark.parametrize("decoder", [Residual(), Flip(), Blend(), Acceleration()])
def test_free_fall_of_a_block_is_exact_where_gravity_is_known(transfer, decoder):
    particles = cloud(box())
    particles = particles.with_motion(particles.position, torch.full_like(particles.velocity, 1e-3))
    path = rollout(silenced(small(box(), transfer, decoder, frames=4)), particles, 20)
    steps = torch.arange(1, 21).view(1, -1, 1, 1)
    exact = particles.position[:, None] + 1e-3 * steps + particles.gravity[:, None, None] * steps * (steps + 1) / 2
    torch.testing.assert_close(path, exact, atol=6e-6, rtol=0)


@pytest.mark.parametrize(("factor", "offset"), [(1000.0, 0.0), (0.01, -3.0), (1.0, 1e8)])
def test_neither_origin_nor_unit_of_length_matters(factor, offset):
    scene = box(gravity=None)
    moved = dataclasses.replace(
        scene,
        bounds=tuple((a * factor + offset, b * factor + offset) for a, b in scene.bounds),
        domain=tuple((a * factor + offset, b * factor + offset) for a, b in scene.domain),
        particle_volume=scene.particle_volume * factor**2,
    )
    particles = cloud(scene)
    there = particles.with_motion(particles.position.double() * factor + offset, particles.velocity.double() * factor)
    back = (rollout(small(moved), there, 6).double() - offset) / factor
    torch.testing.assert_close(back.float(), rollout(small(scene), particles, 6), atol=6e-5, rtol=0)


@pytest.mark.parametrize("constraints", [{}, {"energy": True, "rest_speed": 0.01, "density_cap": 0.5}])
def test_an_emulator_in_float64_computes_in_float64(constraints):
    scene = box(obstacles=True)
    particles, single = cloud(scene, statics=5), emulator_of(scene, processor=SMALL, scale=0.1, **constraints)
    rough, double, state = rollout(single, particles, 8), single.double(), particles.double()
    exact = rollout(double, state, 8)
    assert exact.dtype == torch.float64
    assert 0 < (rough - exact).abs().max() < 1e-5
    moved = rollout(double, state.with_motion(state.position + 1e-12, state.velocity), 8)
    assert 0 < (moved - exact).abs().max() < 1e-10  # lost in float32


def test_obstacles_reach_the_network_and_only_through_the_solid_channel():
    scene = box(obstacles=True)
    particles, emulator = cloud(scene, statics=12), small(scene)
    without = dataclasses.replace(particles, obstacle_mask=torch.zeros_like(particles.obstacle_mask))
    solid = emulator.solid(particles)
    assert solid.shape == (1, 1, 16, 16)
    assert 0 <= solid.min() <= solid.max() <= 1
    assert solid.sum() > emulator.solid(without).sum()
    assert not torch.equal(rollout(emulator, particles, 3), rollout(emulator, without, 3))


def test_transfers_stay_in_float32_under_autocast():
    particles, emulator = cloud(box()), silenced(small(box()))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = rollout(emulator, particles, 6)
    assert low.dtype == torch.float32
    assert torch.equal(low, rollout(emulator, particles, 6))


def test_a_network_in_bfloat16_moves_particles_in_float32():
    emulator, particles = small(box()), cloud(box())
    quick = emulator.with_network(torch.bfloat16)
    with torch.no_grad():
        exact, rough = emulator(particles), quick(particles)
    assert quick.network_precision == torch.bfloat16
    assert emulator.network_precision == rough.position.dtype == torch.float32
    assert 0 < (exact.position - rough.position).abs().max() < 1e-3


@pytest.mark.parametrize("convert", [
    lambda model: model.half(), lambda model: model.bfloat16(), lambda model: model.to(torch.float16),
    lambda model: torch.nn.Sequential(model).to("cpu", torch.bfloat16),
])  # fmt: skip
def test_an_emulator_in_half_precision_is_refused_and_left_as_it_is(convert):
    emulator = emulator_of(box())
    with pytest.raises(ConfigError, match=r"float16 .*with_network\('bfloat16'\).*bf16-mixed"):
        convert(emulator)
    assert {values.dtype for values in emulator.state_dict().values()} == {torch.float32, torch.bool}


def test_rollouts_are_cut_to_the_frames_asked_for():
    particles, emulator = cloud(box()), small(box())
    whole = rollout(emulator, particles, 9)
    for frames in (0, 1, 3, 7):
        assert torch.equal(rollout(emulator, particles, frames), whole[:, :frames])
    assert [part.position.shape[1] for part in stream_rollout(emulator, particles, 7)] == [3, 3, 1]
    with pytest.raises(ValueError, match="frames = -1"):
        rollout(emulator, particles, -1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 0.01}, "made for dt = 0.0025; the other scene has 0.01"),
        ({"materials": ("sand",)}, "input_channels"),
        ({"domain": ((0.08, 0.95), (0.08, 0.92))}, "whole numbers are needed"),
    ],
)
def test_over_another_kind_of_scene_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        small(box()).over(box(**changes))


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_particles_in_chunks_move_as_all_at_once(transfer, monkeypatch):
    scene = box(materials=("water", "sand"))
    emulator, particles = small(scene, transfer), cloud(scene)
    with torch.no_grad(), without_kernels():
        whole = emulator(particles)
        in_sevens = lambda count, *_, **__: [slice(first, first + 7) for first in range(0, count, 7)]  # noqa: E731
        monkeypatch.setattr("nmpm.transfer.chunks", in_sevens)
        cut = emulator(particles)
    torch.testing.assert_close(cut.position, whole.position, rtol=0, atol=1e-6)
    torch.testing.assert_close(cut.velocity, whole.velocity, rtol=0, atol=1e-6)


@pytest.mark.parametrize("training", [False, True])
def test_a_moved_grid_sees_what_the_grid_sees_of_a_scene_moved_the_other_way(training):
    shift, here = (0.013, -0.007), box(obstacles=True)
    bounds = tuple((low - d, high - d) for (low, high), d in zip(here.bounds, shift, strict=True))
    emulator, there = small(here), small(dataclasses.replace(here, bounds=bounds))
    particles, offset = cloud(here, batch=2, speed=0.05, statics=5), torch.tensor(shift)
    moved = dataclasses.replace(particles, position=particles.position - offset, obstacle=particles.obstacle - offset)
    grid_moved = emulator.with_grid_moved(shift).train(training)
    bundle, expected = grid_moved(particles), there.train(training)(moved)
    torch.testing.assert_close(bundle.position - offset, expected.position, atol=2e-6, rtol=0)
    torch.testing.assert_close(bundle.velocity, expected.velocity, atol=2e-6, rtol=0)
    assert (bundle.position - emulator.train(training)(particles).position).abs().max() > 1e-4
    assert grid_moved.processor is emulator.processor


def next_to(value: float, direction: float) -> float:
    return torch.nextafter(torch.tensor(value), torch.tensor(direction)).item()


@pytest.mark.parametrize(("transfer", "decoder"), CASES)
@pytest.mark.parametrize("dim", [2, 3])
def test_values_and_gradients_at_faces_corners_beyond_them_and_beside_empty_cells(transfer, decoder, dim):
    scene = box(dim, ("water", "sand"))
    ends = [0.1, 0.9, 0.08, 0.92, next_to(0.1, 0), next_to(0.9, 1), next_to(0.08, 0), next_to(0.92, 1), -5.0, 7.0, 0.5]
    emulator, particles = small(scene, transfer, decoder, cells=8), cloud(scene, len(ends) ** dim, speed=0.05)
    position = torch.cartesian_prod(*[torch.tensor(ends)] * dim)[None].requires_grad_()
    velocity = particles.velocity.clone().requires_grad_()
    bundle = emulator(particles.with_motion(position, velocity))
    assert bundle.position.shape == (1, 3, len(ends) ** dim, dim)
    assert bundle.position.min() >= 0.1 - 1e-6  # held at the bounds from the first frame on
    assert bundle.position.max() <= 0.9 + 1e-6
    torch.testing.assert_close(bundle.velocity, bundle.position[:, -1] - bundle.position[:, -2], atol=1e-6, rtol=0)
    bundle.position.square().sum().backward()
    for leaf in (position, velocity, *emulator.parameters()):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
