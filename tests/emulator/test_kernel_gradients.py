"""In training, the kernels give the values and gradients of tensor operations, to rounding."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import box, cloud

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.emulator import EmulatorRecipe
from nmpm.emulator.prediction import TensorSteps, TrainingSteps, steps_for
from nmpm.particles import Window
from nmpm.processors import Pointwise
from nmpm.training.losses import TrainingError
from nmpm.transfer import without_kernels

DECODERS = [Absolute(), Residual(), Flip(), Blend(0.8), Acceleration()]


def emulator_of(scene, seed=0, **parts):
    torch.manual_seed(seed)
    return EmulatorRecipe(scene, 10, 3, processor=Pointwise(hidden=(8,)), **parts).build().train()


def scene_of(walls, materials, obstacles=False):
    boundary = tuple("wall" if wall else "periodic" for wall in walls)
    domain = tuple((0.08, 0.92) if wall else (0.1, 0.9) for wall in walls)
    return box(2, ("water", "sand", "goop")[:materials], boundary=boundary, domain=domain, obstacles=obstacles)


def steps_of(emulator, particles):
    return steps_for(emulator, particles, emulator.solid(particles))


def train_once(emulator, particles):
    """Loss, predicted positions, and gradients with respect to the state and all weights, over two bundles."""
    torch.manual_seed(1)
    position, velocity = (values.clone().requires_grad_() for values in (particles.position, particles.velocity))
    state, paths = particles.with_motion(position, velocity), []
    for _ in range(2):
        bundle = emulator(state)
        state = state.with_motion(bundle.position[:, -1], bundle.velocity)
        paths.append(bundle.position)
    predicted = torch.cat(paths, dim=1)
    shift = 0.01 * torch.arange(-1, predicted.shape[1] + 1).clamp(min=0).view(1, -1, 1, 1)
    rest = {name: getattr(particles, name) for name in ("material", "mask", "obstacle", "obstacle_mask", "gravity")}
    window = Window(frames=particles.position.unsqueeze(1) + shift, **rest)
    loss = TrainingError(4.0, 0.5)(predicted, window, emulator.scene, emulator.grid, emulator.frames)
    gradients = torch.autograd.grad(loss, [position, velocity, *emulator.parameters()], allow_unused=True)
    return loss, predicted, [torch.zeros(()) if each is None else each for each in gradients]


def check(walls, materials, decoder, obstacles, count, seed=0, speed=0.005):
    scene = scene_of(walls, materials, obstacles)
    emulator = emulator_of(scene, seed, decoder=decoder)
    particles = cloud(scene, count, 2, speed, seed, statics=5 * obstacles)
    particles.mask[1, (count + 1) // 2 :] = False
    assert isinstance(steps_of(emulator, particles), TrainingSteps)
    loss, predicted, gradients = train_once(emulator, particles)
    with without_kernels():
        assert type(steps_of(emulator, particles)) is TensorSteps
        tensors = train_once(emulator, particles)
    torch.testing.assert_close(loss, tensors[0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(predicted, tensors[1], rtol=0, atol=1e-5)
    for own, other in zip(gradients, tensors[2], strict=True):
        # Where a node has almost no particle, gradients of its mean velocity are large differences, in either form.
        assert (own - other).norm() <= 5e-3 * other.norm() + 1e-6


@pytest.mark.parametrize(
    ("walls", "materials", "decoder", "obstacles", "speed"),
    [
        ((True, True), 1, Residual(), True, 0.005),
        ((False, True), 2, Blend(0.8), False, 0.005),
        ((True, False), 3, Acceleration(), False, 0.005),
        ((True, True), 1, Flip(), False, 0.2),  # walls stop particles, which pass no gradient on
    ],
)
def test_values_and_gradients(walls, materials, decoder, obstacles, speed):
    check(walls, materials, decoder, obstacles, 200, speed=speed)


@pytest.mark.slow
@given(
    walls=st.tuples(st.booleans(), st.booleans()), materials=st.integers(1, 3), decoder=st.sampled_from(DECODERS),
    obstacles=st.booleans(), count=st.sampled_from([1, 17, 300]), seed=st.integers(0, 1000),
)  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_values_and_gradients_of_any_kind(walls, materials, decoder, obstacles, count, seed):
    check(walls, materials, decoder, obstacles, count, seed)


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


def test_a_step_repeats_and_threads_change_nothing_to_the_bit():
    scene = box(materials=("water", "sand"))
    emulator, particles = emulator_of(scene), cloud(scene, 300, 3)
    first, second = (train_once(emulator, particles) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert all(map(torch.equal, first[2], second[2]))
    threads, states = torch.get_num_threads(), []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            states.append(steps_of(emulator, particles).rasterise(particles, emulator.solid(particles))[3])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*states)


@pytest.mark.parametrize("name", ["obstacle", "gravity"])
def test_gradients_of_obstacles_and_gravity_take_tensor_operations(name):
    scene = dataclasses.replace(box(obstacles=True), gravity=None)
    emulator, particles = emulator_of(scene, decoder=Residual()), cloud(scene, 30, statics=10)
    leaf = getattr(particles, name).clone().requires_grad_()
    particles = dataclasses.replace(particles, **{name: leaf})
    assert type(steps_of(emulator, particles)) is TensorSteps
    emulator(particles).position.square().sum().backward()
    assert leaf.grad.abs().sum() > 0


def test_second_derivatives_are_an_error():
    emulator, particles = emulator_of(box()), cloud(box(), 10)
    position = particles.position.clone().requires_grad_()
    bundle = emulator(particles.with_motion(position, particles.velocity))
    (gradient,) = torch.autograd.grad(bundle.position.square().sum(), position, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
