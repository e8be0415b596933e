"""In training, the kernels give the values and gradients of tensor operations, to rounding."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.prediction import TensorSteps, TrainingSteps, steps_for
from nmpm.particles import Window
from nmpm.processors import Pointwise
from nmpm.training.losses import TrainingError
from nmpm.transfer import Linear, Nearest, Quadratic, without_kernels


def emulator_of(scene, cells=10, frames=3, seed=0, **parts):
    torch.manual_seed(seed)
    return EmulatorRecipe(scene, cells, frames, processor=Pointwise(hidden=(8,)), **parts).build().train()


def scene_of(dim, walls, materials, obstacles=False):
    boundary = tuple("wall" if wall else "periodic" for wall in walls[:dim])
    domain = tuple((0.08, 0.92) if wall else (0.1, 0.9) for wall in walls[:dim])
    return box(dim, ("water", "sand", "goop")[:materials], boundary=boundary, domain=domain, obstacles=obstacles)


def steps_of(emulator, particles):
    return steps_for(emulator, particles, emulator.solid(particles))


def train_once(emulator, particles, bundles=2):
    """Loss, predicted positions, and gradients with respect to the state and all weights, of float32 or float64."""
    torch.manual_seed(1)
    position, velocity = (
        values.detach().clone().requires_grad_() for values in (particles.position, particles.velocity)
    )
    own = particles.with_motion(position, velocity)
    paths = []
    for _ in range(bundles):
        bundle = emulator(own)
        own = own.with_motion(bundle.position[:, -1], bundle.velocity)
        paths.append(bundle.position)
    predicted = torch.cat(paths, dim=1)
    shift = 0.01 * torch.arange(1, predicted.shape[1] + 1, dtype=predicted.dtype).view(1, -1, 1, 1)
    start = torch.stack([particles.position - particles.velocity, particles.position], dim=1)
    frames = torch.cat([start, particles.position.unsqueeze(1) + shift], dim=1)
    rest = {name: getattr(particles, name) for name in ("material", "mask", "obstacle", "obstacle_mask", "gravity")}
    loss = TrainingError(4.0, 0.5)(
        predicted, Window(frames=frames, **rest), emulator.scene, emulator.grid, emulator.frames
    )
    gradients = torch.autograd.grad(loss, [position, velocity, *emulator.parameters()], allow_unused=True)
    return loss, predicted, [torch.zeros(()) if each is None else each for each in gradients]


def assert_equal_to_rounding(emulator, particles):
    assert isinstance(steps_of(emulator, particles), TrainingSteps)
    found = train_once(emulator, particles)
    with without_kernels():
        assert isinstance(steps_of(emulator, particles), TensorSteps)
        tensors = train_once(emulator, particles)
    torch.testing.assert_close(found[0], tensors[0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found[1], tensors[1], rtol=0, atol=1e-5)
    for own, other in zip(found[2], tensors[2], strict=True):
        # Where a node has almost no particle, gradients of its mean velocity are large differences, in either form.
        assert (own - other).norm() <= 5e-3 * other.norm() + 1e-6


@given(
    walls=st.lists(st.booleans(), min_size=2, max_size=2),
    materials=st.integers(1, 3),
    decoder=st.sampled_from([Absolute(), Residual(), Flip(), Blend(0.8), Acceleration()]),
    obstacles=st.booleans(),
    count=st.sampled_from([1, 17, 300]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=8, deadline=None)
def test_values_and_gradients_are_those_of_tensor_operations(walls, materials, decoder, obstacles, count, seed):
    scene = scene_of(2, walls, materials, obstacles)
    emulator = emulator_of(scene, seed=seed, decoder=decoder, transfer=Linear())
    particles = cloud(scene, count, 2, 0.005, seed, statics=5 * obstacles)
    particles.mask[1, (count + 1) // 2 :] = False
    assert_equal_to_rounding(emulator, particles)


def test_scenes_in_three_dimensions_take_tensor_operations():
    scene = scene_of(3, (True, True, True), 1)
    assert not isinstance(steps_of(emulator_of(scene), cloud(scene, 20, 2)), TrainingSteps)


def test_particles_stopped_by_walls_pass_no_gradient_on():
    scene = box()
    assert_equal_to_rounding(emulator_of(scene), cloud(scene, 200, 2, speed=0.2))


def test_padding_gets_no_gradient_and_changes_none():
    scene = box(materials=("water", "sand"))
    emulator, particles = emulator_of(scene), cloud(scene, 40)
    padded = cloud(scene, 60)
    for name in ("position", "velocity", "material"):
        getattr(padded, name)[:, :40] = getattr(particles, name)
    padded.mask[:, 40:] = False
    alone, together = train_once(emulator, particles)[2], train_once(emulator, padded)[2]
    for own, other in zip(alone[:2], together[:2], strict=True):
        assert torch.equal(own, other[:, :40])
        assert not other[:, 40:].any()
    assert all(map(torch.equal, alone[2:], together[2:]))


def test_the_number_of_threads_changes_nothing_to_the_bit():
    scene = box(materials=("water", "sand"))
    emulator, particles = emulator_of(scene), cloud(scene, 300, 3)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 3, 3):
            torch.set_num_threads(number)
            start = steps_of(emulator, particles).rasterise(particles, emulator.solid(particles))
            results.append([*start[:2], start[3]])
    finally:
        torch.set_num_threads(threads)
    assert all(map(torch.equal, results[0], results[1]))
    assert all(map(torch.equal, results[1], results[2]))


def test_a_step_repeats_to_the_bit():
    scene = box(materials=("water", "sand"))
    emulator, particles = emulator_of(scene), cloud(scene, 300, 3)
    first, second = (train_once(emulator, particles) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert all(map(torch.equal, first[2], second[2]))


@pytest.mark.parametrize("name", ["obstacle", "gravity"])
def test_gradients_of_obstacles_and_gravity_take_tensor_operations(name):
    scene = dataclasses.replace(box(obstacles=True), gravity=None)
    emulator = emulator_of(scene, decoder=Residual())
    particles = cloud(scene, 30, statics=10)
    leaf = getattr(particles, name).clone().requires_grad_()
    particles = dataclasses.replace(particles, **{name: leaf})
    assert isinstance(steps_of(emulator, particles), TensorSteps)
    assert not isinstance(steps_of(emulator, particles), TrainingSteps)
    emulator(particles).position.square().sum().backward()
    assert leaf.grad.abs().sum() > 0


def test_what_has_no_kernel_takes_tensor_operations():
    scene = box()
    particles = cloud(scene, 10)
    for parts in ({"transfer": Nearest()}, {"transfer": Quadratic()}, {"constraints": Constraints(bounds="reflect")}):
        assert not isinstance(steps_of(emulator_of(scene, **parts), particles), TrainingSteps)
    assert not isinstance(steps_of(emulator_of(scene).double(), particles), TrainingSteps)
    assert not isinstance(steps_of(emulator_of(scene).eval(), particles), TrainingSteps)


def test_second_derivatives_are_an_error():
    scene = box()
    emulator, particles = emulator_of(scene), cloud(scene, 10)
    position = particles.position.clone().requires_grad_()
    bundle = emulator(particles.with_motion(position, particles.velocity))
    (gradient,) = torch.autograd.grad(bundle.position.square().sum(), position, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
