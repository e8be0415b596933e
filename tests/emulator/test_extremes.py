"""The building blocks at the extremes: counts, places, shapes, scales, precision, poison."""

import dataclasses
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.rollouts import rollout
from nmpm.errors import DataError
from nmpm.particles import Particles
from nmpm.processors import Pointwise
from nmpm.scene import Scene
from nmpm.transfer import Affine, Linear, Nearest, Quadratic

TRANSFERS = [Nearest(), Linear(), Quadratic(), Affine()]


def emulator_of(scene: Scene, transfer=None, cells=16, frames=2) -> Emulator:
    torch.manual_seed(0)
    return EmulatorRecipe(scene, cells, frames, transfer or Linear(), Pointwise(hidden=(4,))).build().eval()


def at(scene: Scene, position: torch.Tensor, velocity: float = 0.0) -> Particles:
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
    emulator, particles = emulator_of(scene, transfer), at(scene, position, 1e-3)
    predicted = emulator(particles).position
    assert predicted.isfinite().all()
    assert predicted.min() >= 0.1 - 1e-6  # held at the bounds from the first frame on
    assert predicted.max() <= 0.9 + 1e-6


@pytest.mark.slow
@given(
    shape=st.sampled_from([(1, 13), (17, 1), (2, 3), (31, 37), (8, 8), (128, 3), (257, 9)]),
    transfer=st.sampled_from(TRANSFERS),
    seed=st.integers(0, 100),
)
@settings(max_examples=40, deadline=None)
def test_thin_odd_and_prime_grids(shape, transfer, seed):
    scene = box()
    emulator = emulator_of(scene, transfer, cells=shape)
    predicted = rollout(emulator, cloud(scene, seed=seed), 4)
    assert predicted.isfinite().all()


def far_away(offset: float) -> Scene:
    return box(bounds=((offset + 0.1, offset + 0.9),) * 2, domain=((offset + 0.08, offset + 0.92),) * 2, gravity=None)


def test_an_origin_too_far_for_float32_is_refused_by_name():
    scene = far_away(1e8)
    particles = cloud(box(gravity=None))
    particles = particles.with_motion(particles.position + 1e8, particles.velocity)
    with pytest.raises(
        DataError, match=r"float32 numbers have a spacing of 8 near 1e\+08.*subtract its lower corner.*float64"
    ):
        rollout(emulator_of(scene), particles, 2)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_gradients_are_finite_beside_empty_cells_and_walls(transfer):
    scene = box(materials=("water", "sand"))
    particles = cloud(scene, count=6)
    position = particles.position.clone()
    position[0, 0], position[0, 1] = torch.tensor([0.1, 0.9]), torch.tensor([0.9, 0.9])
    leaf = position.requires_grad_()
    velocity = particles.velocity.clone().requires_grad_()
    emulator = emulator_of(scene, transfer)
    moved = particles.with_motion(leaf, velocity)
    bundle = emulator(moved)
    bundle.position.square().sum().backward()
    for tensor in (leaf.grad, velocity.grad, *(p.grad for p in emulator.parameters())):
        assert tensor is not None
        assert tensor.isfinite().all()


class TestPoison:
    @pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
    @pytest.mark.parametrize("what", ["position", "velocity"])
    def test_what_is_no_number_is_named_and_not_spread(self, bad, what):
        scene = box()
        particles = cloud(scene, batch=2)
        values = getattr(particles, what).clone()
        values[1, 3, 0] = bad
        poisoned = dataclasses.replace(particles, **{what: values})
        with pytest.raises(DataError, match=f"Scene 1 of the batch, particle 3: its {what} is"):
            rollout(emulator_of(scene), poisoned, 2)

    def test_particles_outside_are_named_and_not_clamped(self):
        scene = box()
        particles = cloud(scene)
        position = particles.position.clone()
        position[0, 5, 1] = 1.5
        with pytest.raises(DataError, match=r"particle 5: it is at .* outside of the domain .* \(1 particles are\)"):
            rollout(emulator_of(scene), particles.with_motion(position, particles.velocity), 2)

    def test_padding_may_hold_anything(self):
        scene = box()
        particles = cloud(scene)
        mask = particles.mask.clone()
        mask[0, 5] = False
        position = particles.position.clone()
        position[0, 5] = 9.0
        padded = dataclasses.replace(particles, position=position, mask=mask)
        assert rollout(emulator_of(scene), padded, 2).isfinite().all()


@pytest.mark.slow
def test_gradients_at_places_that_are_no_numbers_do_not_end_the_process():
    """Torch's sampler crashes there on a CPU, so another process tries it."""
    program = """
import torch
from nmpm.grid import Grid
from nmpm.transfer import Linear
field = torch.randn(2, 2, 64, 64).to(memory_format=torch.channels_last).requires_grad_()
cells = 64 * torch.rand(2, 1800, 2)
cells[0, ::3], cells[1, ::5] = float("nan"), float("inf")
Linear().g2p(field, cells.requires_grad_(), Grid((64, 64), (0.0, 0.0), (1.0, 1.0), (False, False))).sum().backward()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
