import dataclasses

import pytest
import torch
from scenes import box, cloud

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.calibration import calibrate
from nmpm.emulator.rasterise import grid_state
from nmpm.emulator.rollouts import rollout, stream
from nmpm.errors import ConfigError
from nmpm.particles import Particles, Window
from nmpm.processors import Pointwise, UNet
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


def test_what_the_decoders_hold():
    scene = box(gravity=None)
    particles = cloud(scene, speed=0.003)
    still = silenced(small(scene, decoder=Absolute()))
    assert torch.allclose(rollout(still, particles, 3), particles.position[:, None].expand(-1, 3, -1, -1), atol=1e-6)
    own = silenced(small(scene, decoder=Flip()))
    expected = particles.position + 3 * particles.velocity
    assert torch.allclose(rollout(own, particles, 3)[:, -1], expected, atol=1e-6)
    smoothed = rollout(silenced(small(scene, decoder=Residual())), particles, 3)[:, -1] - particles.position
    assert smoothed.var() < (3 * particles.velocity).var()


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


def test_each_material_follows_its_own_velocity_field():
    scene = box(materials=("water", "sand"), gravity=None)
    particles = cloud(scene)
    emulator = silenced(small(scene, processor=Pointwise(), frames=1, decoder=Absolute()))
    final = emulator.processor.perceptron[-1]
    with torch.no_grad():
        final.bias.copy_(torch.tensor([1.0, 0.0, 0.0, 2.0]))  # water to the right, sand upwards, in cells per frame
    moved = emulator.grid.to_cell_displacement(rollout(emulator, particles, 1)[:, 0] - particles.position)
    expected = torch.tensor([[1.0, 0.0], [0.0, 2.0]])[particles.material]
    torch.testing.assert_close(moved, expected, atol=1e-4, rtol=0)


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


def test_walls_fill_the_share_of_the_domain_beyond_the_bounds():
    scene = box()
    emulator = small(scene, cells=64)
    solid = emulator.solid(cloud(scene))
    assert solid.mean().item() == pytest.approx(1 - (0.8 / 0.84) ** 2, rel=1e-5)


def test_transfers_stay_in_float32_under_autocast():
    scene = box()
    particles = cloud(scene)
    emulator = silenced(small(scene))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        low = rollout(emulator, particles, 6)
    assert low.dtype == torch.float32
    assert torch.equal(low, rollout(emulator, particles, 6))


def test_calibration_measures_what_the_network_has_to_give():
    scene = box(gravity=None)
    particles = cloud(scene, count=50, batch=4)
    generator = torch.Generator().manual_seed(1)
    steps = 0.002 + 0.001 * torch.randn(4, 6, 50, 2, generator=generator)
    frames = particles.position[:, None] + steps.cumsum(1)
    rest = (particles.material, particles.mask, particles.obstacle, particles.obstacle_mask, particles.gravity)
    window = Window(frames, *rest)
    emulator = small(scene, decoder=Absolute())
    calibrate(emulator, [window])
    expected = emulator.grid.to_cell_displacement(steps[:, 2:]).square().mean((0, 1, 2)).sqrt()
    torch.testing.assert_close(emulator.output_scale.squeeze().mean(0), expected, rtol=0.05, atol=0)
    assert emulator.calibrated
    start = window.initial
    cells, velocity, _ = emulator.in_cells(start)
    state = grid_state(scene, emulator.grid, emulator.transfer, start, cells, velocity, emulator.solid(start))
    assert (state > emulator.input_low).all()
    assert (state < emulator.input_high).all()
    normalised = (state - emulator.input_mean) / emulator.input_std
    assert normalised.mean((0, 2, 3)).abs().max() < 1e-4
    with pytest.raises(ValueError, match="at least 5 frames"):
        calibrate(emulator, [dataclasses.replace(window, frames=frames[:, :4])])


def test_a_material_that_the_calibration_does_not_see_gets_the_scales_of_the_others():
    scene = box(gravity=None, materials=("water", "sand", "goop"))
    particles = cloud(scene, count=60, batch=4)
    particles = dataclasses.replace(particles, material=torch.arange(60).expand(4, -1) % 2 * 2)  # no sand
    frames = particles.position[:, None] + 0.002 * torch.randn(4, 6, 60, 2).cumsum(1)
    rest = (particles.material, particles.mask, particles.obstacle, particles.obstacle_mask, particles.gravity)
    emulator = small(scene)
    with pytest.warns(UserWarning, match="no particles of sand"):
        calibrate(emulator, [Window(frames, *rest)])
    scale = emulator.output_scale.squeeze().unflatten(-1, (3, 2))
    torch.testing.assert_close(scale[:, 1].square(), (scale[:, 0].square() + scale[:, 2].square()) / 2)
    for figures in (emulator.input_mean.flatten(), emulator.input_std.flatten()):
        velocity, volume = figures[:6].view(3, 2), figures[6:9]
        torch.testing.assert_close(velocity[1], velocity[[0, 2]].mean(0))
        torch.testing.assert_close(volume[1], volume[[0, 2]].mean())


def test_rollouts_are_cut_to_the_frames_asked_for():
    scene = box()
    particles, emulator = cloud(scene), small(scene, frames=3)
    whole = rollout(emulator, particles, 9)
    for frames in (0, 1, 3, 7):
        assert torch.equal(rollout(emulator, particles, frames), whole[:, :frames])
    assert [len(part[0]) for part in stream(emulator, particles, 7)] == [3, 3, 1]
    with pytest.raises(ValueError, match="frames = -1"):
        rollout(emulator, particles, -1)


WIDE = {"bounds": ((0.1, 1.74), (0.1, 0.9)), "domain": ((0.08, 1.76), (0.08, 0.92))}


@pytest.mark.parametrize("dim", [2, 3])
def test_over_a_wider_box_what_is_far_from_the_walls_moves_as_before(dim):
    scene = box(dim)
    wide = box(dim, **{key: (*value, *value[1:] * (dim - 2)) for key, value in WIDE.items()})
    emulator, particles = small(scene, processor=Pointwise(hidden=(4,))), cloud(scene)
    other = emulator.over(wide)
    assert other.grid.shape == (32,) + (16,) * (dim - 1)
    torch.testing.assert_close(rollout(other, particles, 5), rollout(emulator, particles, 5), atol=1e-6, rtol=0)
    shifted = particles.with_motion(particles.position + torch.tensor([0.84] + [0.0] * (dim - 1)), particles.velocity)
    moved = rollout(other, shifted, 5) - torch.tensor([0.84] + [0.0] * (dim - 1))
    torch.testing.assert_close(moved, rollout(emulator, particles, 5), atol=1e-5, rtol=0)


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


def test_periods_move_with_the_grid_and_walls_must_stay_on_it():
    everywhere = ((0.08, 0.92),) * 2
    scene = box(bounds=everywhere, domain=everywhere, boundary=("periodic",) * 2, gravity=(0.0, 0.0))
    emulator, particles = small(scene), cloud(scene, speed=0.05)
    cell = emulator.grid.spacing[0]
    same = emulator.with_grid_moved((cell, -2 * cell))(particles)  # a torus looks the same from the next cell
    torch.testing.assert_close(same.position, emulator(particles).position, atol=2e-6, rtol=0)
    with pytest.raises(ConfigError, match="must contain the bounds"):
        small(box()).with_grid_moved((0.03, 0.0))
