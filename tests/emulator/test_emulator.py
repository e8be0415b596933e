import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.rollouts import rollout, stream
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.processors import UNet
from nmpm.transfer import Affine, Linear, Nearest, Quadratic, without_kernels

SMALL = UNet(width=4, depth=1, perceptron=(4,))
TRANSFERS = (Nearest(), Linear(), Quadratic(), Affine())
DECODERS = (Absolute(), Residual(), Flip(), Blend(), Acceleration())
CASES = [(t, Residual()) for t in TRANSFERS] + [(Linear(), d) for d in DECODERS]


def small(scene, transfer=Linear(), decoder=Residual(), processor=SMALL, frames=3, cells=16):
    torch.manual_seed(0)
    return EmulatorRecipe(scene, cells, frames, transfer, processor, decoder).build().eval()


def silenced(emulator):
    """The emulator with a network that always says zero."""
    for parameter in emulator.processor.parameters():
        torch.nn.init.zeros_(parameter)
    return emulator


@pytest.mark.parametrize(("transfer", "decoder"), CASES)
@pytest.mark.parametrize("dim", [2, 3])
def test_every_combination_predicts_finite_bundles_within_the_walls(transfer, decoder, dim):
    scene = box(dim, ("water", "sand"))
    particles = cloud(scene, batch=2, speed=0.05)
    emulator = small(scene, transfer, decoder, cells=8)
    bundle = emulator(particles)
    assert bundle.position.shape == (2, 3, 30, dim)
    assert bundle.velocity.shape == (2, 30, dim)
    assert bundle.position.min() >= 0.1 - 1e-6
    assert bundle.position.max() <= 0.9 + 1e-6
    torch.testing.assert_close(bundle.velocity, bundle.position[:, -1] - bundle.position[:, -2], atol=1e-6, rtol=0)


@pytest.mark.parametrize("transfer", [Linear(), Quadratic(), Affine()])
@pytest.mark.parametrize("decoder", [Residual(), Flip(), Blend(), Acceleration()])
def test_free_fall_of_a_block_is_exact_where_gravity_is_known(transfer, decoder):
    scene = box()
    particles = cloud(scene)
    particles = particles.with_motion(particles.position, torch.zeros_like(particles.velocity) + 1e-3)
    path = rollout(silenced(small(scene, transfer, decoder, frames=4)), particles, 20)
    steps = torch.arange(1, 21).view(1, -1, 1, 1)
    exact = particles.position[:, None] + 1e-3 * steps + particles.gravity[:, None, None] * steps * (steps + 1) / 2
    torch.testing.assert_close(path, exact, atol=6e-6, rtol=0)


@pytest.mark.parametrize("transfer", [Nearest(), Linear(), Quadratic()])
def test_padding_changes_nothing_to_the_bit(transfer):
    scene = box()
    particles = cloud(scene, count=20)
    padded = Particles(
        position=torch.cat([particles.position, torch.full((1, 7, 2), 0.5)], 1),
        velocity=torch.cat([particles.velocity, torch.full((1, 7, 2), 0.3)], 1),
        material=torch.cat([particles.material, torch.zeros(1, 7, dtype=torch.long)], 1),
        mask=torch.cat([particles.mask, torch.zeros(1, 7, dtype=torch.bool)], 1),
        obstacle=torch.full((1, 3, 2), 0.5),
        obstacle_mask=torch.zeros(1, 3, dtype=torch.bool),
        gravity=particles.gravity,
    )
    emulator = small(scene, transfer)
    assert torch.equal(rollout(emulator, padded, 9)[:, :, :20], rollout(emulator, particles, 9))


@pytest.mark.parametrize(("factor", "offset"), [(1000.0, 0.0), (0.01, -3.0)])
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
    here = rollout(small(scene), particles, 6)
    back = (rollout(small(moved), there, 6).double() - offset) / factor
    torch.testing.assert_close(back.float(), here, atol=2e-5 * max(1, abs(offset)), rtol=0)


def test_obstacles_reach_the_network_and_only_through_the_solid_channel():
    scene = box(obstacles=True)
    particles = cloud(scene, statics=12)
    emulator = small(scene)
    solid = emulator.solid(particles)
    assert solid.shape == (1, 1, 16, 16)
    assert 0 <= solid.min() <= solid.max() <= 1
    without = dataclasses.replace(particles, obstacle_mask=torch.zeros_like(particles.obstacle_mask))
    assert solid.sum() > emulator.solid(without).sum()
    assert not torch.equal(rollout(emulator, particles, 3), rollout(emulator, without, 3))


def test_transfers_stay_in_float32_under_autocast():
    scene = box()
    particles = cloud(scene)
    emulator = silenced(small(scene))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = rollout(emulator, particles, 6)
    assert low.dtype == torch.float32
    assert torch.equal(low, rollout(emulator, particles, 6))


def test_rollouts_are_cut_to_the_frames_asked_for():
    scene = box()
    particles, emulator = cloud(scene), small(scene, frames=3)
    whole = rollout(emulator, particles, 9)
    for frames in (0, 1, 3, 7):
        assert torch.equal(rollout(emulator, particles, frames), whole[:, :frames])
    assert [len(part[0]) for part in stream(emulator, particles, 7)] == [3, 3, 1]
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


def in_sevens(count, device, values=1):
    return [slice(first, first + 7) for first in range(0, count, 7)]


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_particles_in_chunks_move_as_all_at_once(transfer, monkeypatch):
    scene = box(materials=("water", "sand"))
    emulator, particles = small(scene, transfer), cloud(scene)
    with torch.no_grad(), without_kernels():
        whole = emulator(particles)
        monkeypatch.setattr("nmpm.transfer.transfer.chunks", in_sevens)
        cut = emulator(particles)
    torch.testing.assert_close(cut.position, whole.position, rtol=0, atol=1e-6)
    torch.testing.assert_close(cut.velocity, whole.velocity, rtol=0, atol=1e-6)


def test_a_network_in_bfloat16_moves_particles_in_float32():
    scene = box()
    emulator, particles = small(scene), cloud(scene)
    quick = emulator.with_network(torch.bfloat16)
    with torch.no_grad():
        exact, rough = emulator(particles), quick(particles)
    assert quick.network_precision == torch.bfloat16
    assert emulator.network_precision == rough.position.dtype == torch.float32
    assert 0 < (exact.position - rough.position).abs().max() < 1e-3


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("obstacles", [False, True])
def test_a_moved_grid_sees_what_the_grid_sees_of_a_scene_moved_the_other_way(training, obstacles):
    shift, here = (0.013, -0.007), box(obstacles=obstacles)
    bounds = tuple((low - d, high - d) for (low, high), d in zip(here.bounds, shift, strict=True))
    emulator, there = small(here), small(dataclasses.replace(here, bounds=bounds))
    there.load_state_dict(emulator.state_dict())
    particles = cloud(here, batch=2, speed=0.05, statics=5 if obstacles else 0)
    offset = torch.tensor(shift)
    moved = dataclasses.replace(particles, position=particles.position - offset, obstacle=particles.obstacle - offset)
    own = emulator.with_grid_moved(shift).train(training)
    found, expected = own(particles), there.train(training)(moved)
    torch.testing.assert_close(found.position - offset, expected.position, atol=2e-6, rtol=0)
    torch.testing.assert_close(found.velocity, expected.velocity, atol=2e-6, rtol=0)
    assert (found.position - emulator.train(training)(particles).position).abs().max() > 1e-4
    assert own.processor is emulator.processor


def at(scene, position: torch.Tensor, velocity: float = 0.0) -> Particles:
    """Particles (N, D) of the first material, all with one velocity."""
    count = len(position)
    return Particles(
        position=position[None],
        velocity=torch.full_like(position[None], velocity),
        material=torch.zeros(1, count, dtype=torch.int64),
        mask=torch.ones(1, count, dtype=torch.bool),
        obstacle=position.new_zeros(1, 0, scene.dim),
        obstacle_mask=torch.zeros(1, 0, dtype=torch.bool),
        gravity=position.new_zeros(1, scene.dim),
    )


def _near(value: float, direction: float) -> float:
    return torch.nextafter(torch.tensor(value), torch.tensor(direction)).item()


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_faces_corners_bounds_and_a_hair_beyond(transfer):
    scene = box()
    places = [0.1, 0.9, 0.08, 0.92, _near(0.1, 0), _near(0.9, 1), _near(0.08, 0), _near(0.92, 1), -5.0, 7.0, 0.5]
    position = torch.cartesian_prod(torch.tensor(places), torch.tensor(places))
    emulator, particles = small(scene, transfer), at(scene, position, 1e-3)
    predicted = emulator(particles).position
    assert predicted.isfinite().all()
    assert predicted.min() >= 0.1 - 1e-6  # held at the bounds from the first frame on
    assert predicted.max() <= 0.9 + 1e-6


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_gradients_are_finite_beside_empty_cells_and_walls(transfer):
    scene = box(materials=("water", "sand"))
    particles = cloud(scene, count=6)
    position = particles.position.clone()
    position[0, 0], position[0, 1] = torch.tensor([0.1, 0.9]), torch.tensor([0.9, 0.9])
    leaf = position.requires_grad_()
    velocity = particles.velocity.clone().requires_grad_()
    emulator = small(scene, transfer)
    moved = particles.with_motion(leaf, velocity)
    bundle = emulator(moved)
    bundle.position.square().sum().backward()
    for tensor in (leaf.grad, velocity.grad, *(p.grad for p in emulator.parameters())):
        assert tensor is not None
        assert tensor.isfinite().all()
