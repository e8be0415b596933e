"""The GPU's kernels, run by Triton's interpreter on a CPU, give what tensor operations give."""

import dataclasses
import os
import subprocess
import sys
import warnings
from types import SimpleNamespace

import pytest
import torch

from nmpm.decoders import Absolute, Acceleration, Blend, Flip
from nmpm.emulator import Emulator, RolloutContext, rollout
from nmpm.emulator.engines import ENGINES, find_engine, graphs, rules
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.rollouts import recomputed
from nmpm.particles import Particles, lattice
from nmpm.processors import UNet
from nmpm.training import recorded_steps
from nmpm.transfer import without_kernels
from tests.scenes import CHANNEL, box, cloud, emulator_of, window_of, with_obstacle


def moving(scene, reach: float = 0.3, cells=8, frames: int = 3, **parts) -> Emulator:
    """With random weights that move particles by about `reach` cells in a frame."""
    network = UNet(width=4, depth=1, perceptron=(4,))
    return emulator_of(scene, cells, frames, processor=network, scale=reach, **parts).requires_grad_(False)


FAST = {"batch": 2, "speed": 0.04}
STILL = {"decoder": Absolute(), "rest_speed": 1.0, "reach": 0.05}
CASES = {
    "free": (box(), {}, {}),
    "one frame": (box(), {"frames": 1, "rest_speed": 0.5}, {}),
    "energy": (box(), {"energy": True, "reach": 0.6}, {"speed": 0.002}),
    "at rest": (box(), STILL | {"seed": 4}, {}),
    "at rest, gravity differs": (box(gravity=None, gravity_varies=True), STILL | {"seed": 3}, {"batch": 2}),
    "obstacles": (box(obstacles=True), {"rest_speed": 0.3, "frames": 2}, FAST),
    "crowded": (box(obstacles=True), {"energy": True, "density_cap": 0.2, "reach": 0.02, "frames": 2}, {"speed": 0.02}),
    "crowded, free": (box(), {"density_cap": 0.08, "reach": 0.02}, {}),
    "materials": (
        box(materials=("water", "sand"), densities=(1.0, 3.0)),
        {"energy": True, "density_cap": 0.08, "rest_speed": 0.3, "seed": 1, "frames": 2},
        {"speed": 0.002},
    ),
    "acceleration": (box(**CHANNEL), {"cells": (8, 6), "decoder": Acceleration(), "energy": True}, {}),
    "blend, gravity differs": (
        box(gravity=None, gravity_varies=True), {"decoder": Blend(), "energy": True}, {"batch": 2},
    ),
    "periodic, at rest": (box(**CHANNEL), STILL | {"cells": (8, 6), "seed": 4}, {}),
}  # fmt: skip


def state_of(scene, **motion) -> Particles:
    """A cloud, some of it padded, where there are obstacles with a wall of two cells; gravity may differ."""
    state = cloud(scene, **{"count": 40, "speed": 0.005} | motion)
    state.mask[:, -3:] = False
    if scene.obstacles:
        state = with_obstacle(state, lattice(((0.49, 0.61), (0.2, 0.6)), 0.02))
    gravity = torch.tensor([[0.0, 2e-4], [-3e-4, 1e-4]])[: len(state.position)]
    return dataclasses.replace(state, gravity=gravity) if scene.gravity_varies else state


@pytest.fixture
def triton(monkeypatch, device):
    """Lets emulators take the kernels; without a GPU in Triton's interpreter, and without recordings."""
    pytest.importorskip("triton", reason="triton is not installed")
    from nmpm.emulator.engines.triton import launch

    monkeypatch.setattr(launch, "BLOCK", 32)  # more than one program for each scene
    if device.type != "cuda":
        if torch.cuda.is_available():
            pytest.skip("kernels are compiled for the GPU: --device cuda")
        on_gpu(monkeypatch)


def on_gpu(monkeypatch) -> None:
    """Let engines be chosen as on a CUDA GPU with Triton."""
    monkeypatch.setattr(rules.Call, "device", "cuda")
    monkeypatch.setattr(graphs, "RECORDINGS", (rules.Rule("a stand-in for a GPU", (), lambda _: True),))
    monkeypatch.setattr(rules, "_has_triton", lambda: True)


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("name", CASES)
def test_bundles_are_those_of_tensor_operations(name, device, monkeypatch):
    from nmpm.emulator.engines.triton import launch

    scene, form, motion = CASES[name]
    emulator, state = moving(scene, **form).to(device), state_of(scene, **motion).to(device)
    for most in (launch.ONE_PROGRAM, 0):  # a scene in one program, and in several
        monkeypatch.setattr(launch, "ONE_PROGRAM", most)
        with torch.no_grad():
            context = emulator.context(state)
            there = ENGINES["triton"](emulator).predict(state, context)
            here = TorchEngine(emulator).predict(state, context)
        gap = (there.position - here.position).abs().amax((1, 3)) / emulator.grid.spacing[0]
        speed = (there.velocity - here.velocity).abs().amax(2) / emulator.grid.spacing[0]
        apart = ~(gap.maximum(speed) <= 1e-4) & state.mask
        # A GPU rounds otherwise, which decides on which side of a threshold few particles are.
        assert apart.sum() <= (0 if device.type == "cpu" else 0.05 * state.mask.sum())
        state = here.state_after(state)


TRAININGS = {
    "residual": (box(obstacles=True), {}, {"batch": 2}),
    "blend, materials, periodic": (
        box(materials=("water", "sand"), **CHANNEL), {"decoder": Blend(0.8), "cells": (8, 6)}, {},
    ),
    "acceleration": (box(), {"decoder": Acceleration()}, {}),
    "bounds": (box(), {"decoder": Flip()}, {"speed": 0.2}),  # walls stop particles, which pass no gradient on
    "absolute, gravity differs": (box(gravity=None, gravity_varies=True), {"decoder": Absolute()}, {"batch": 2}),
}  # fmt: skip


def gradients_of(engine, emulator, state):
    """Positions of a bundle, and gradients with respect to positions, velocities and weights."""
    motion = [values.clone().requires_grad_() for values in (state.position, state.velocity)]
    bundle = engine.predict(state.with_motion(*motion), emulator.surroundings(state, None))
    path = bundle.position.where(state.mask[:, None, :, None], 0.5)
    loss = (path - 0.5).square().mean() + bundle.velocity.where(state.mask.unsqueeze(-1), 0.0).square().mean()
    return path.detach(), torch.autograd.grad(loss, [*motion, *emulator.parameters()])


def check_training(emulator, reference, state):
    """Values and gradients by kernels are those of tensor operations, of an emulator with the same weights."""
    path, gradients = gradients_of(ENGINES["triton training"](emulator), emulator, state)
    expected, others = gradients_of(TorchEngine(reference), reference, state)
    torch.testing.assert_close(path, expected, rtol=0, atol=1e-5)
    for gradient, other in zip(gradients, others, strict=True):
        # Where a node has almost no particle, gradients of its mean velocity are large differences, in either form.
        assert (gradient - other).norm() <= 5e-3 * other.norm() + 1e-9


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("name", TRAININGS)
def test_trainings_have_the_values_and_gradients_of_tensor_operations(name, device):
    scene, form, motion = TRAININGS[name]
    emulator = moving(scene, **form).train().requires_grad_().to(device)
    state = state_of(scene, **motion).to(device)
    if scene.obstacles:
        state = dataclasses.replace(state, volume=torch.linspace(0.5, 2.0, 40, device=device).expand(2, -1))
    check_training(emulator, emulator, state)


@pytest.mark.usefixtures("triton")
def test_gradients_of_outputs_in_bfloat16_have_their_precision(device):
    emulator, state = moving(box()).train().requires_grad_().to(device), state_of(box()).to(device)
    with torch.autocast(device.type, torch.bfloat16):
        _, gradients = gradients_of(ENGINES["triton training"](emulator), emulator, state)
        _, others = gradients_of(TorchEngine(emulator), emulator, state)
    for gradient, other in zip(gradients, others, strict=True):
        assert gradient.dtype == other.dtype
        assert (gradient - other).norm() <= 0.05 * other.norm() + 1e-9


@pytest.mark.usefixtures("triton")
def test_the_grid_may_move_where_steps_are_recorded(device):
    emulator, state = moving(box()).train().requires_grad_().to(device), state_of(box()).to(device)
    moved = emulator.with_grid_moved((0.01, -0.008))
    window = window_of(state, state.position.unsqueeze(1).expand(-1, 3, -1, -1))
    inputs = recorded_steps._inputs(emulator, moved, state, window)
    _, _, placed = recorded_steps._arguments(emulator, window, inputs)
    check_training(placed, moved, state)


@pytest.mark.usefixtures("triton")
def test_rollouts_go_on_from_states_of_any_size_and_precision(device):
    emulator = moving(box(), energy=True).to(device)
    for count in (30, 1):
        state = cloud(box(), count, seed=count).to(device)
        for given in (state, state.double()):
            with without_kernels():
                expected = rollout(emulator, given, 4)
            predicted = rollout(emulator, given, 4)
            assert predicted.dtype == expected.dtype
            torch.testing.assert_close(predicted, expected, rtol=0, atol=1e-4 * emulator.grid.spacing[0])


@pytest.mark.usefixtures("triton")
def test_kernels_that_give_what_torch_gives_are_used(device, recwarn):
    emulator, state = moving(box(), energy=True).to(device), state_of(box())
    emulator(state.to(device))
    assert find_engine(emulator, state.to(device), emulator.solid(state.to(device))).name == "triton"
    trained = moving(box(materials=("water", "sand"))).train().requires_grad_().to(device)
    state = state_of(trained.scene).to(device)
    recomputed(trained, state, trained.context(state)).position.sum().backward()
    assert find_engine(trained, state, trained.solid(state)).name == "triton training"
    assert not recwarn.list


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda bundle: 1 / 0, r"they fail here \(ZeroDivisionError: division by zero\)"),
        (
            lambda b: dataclasses.replace(b, position=b.position + 0.01),
            r"differ by 0.\d+ cells, where 0.001",
        ),
        (lambda b: dataclasses.replace(b, position=b.position * torch.nan), "differ by nan cells"),
        (lambda bundle: bundle, ""),
    ],
    ids=["fail", "differ", "are not finite", "agree"],
)
def test_kernels_that_fail_or_differ_are_left_to_torch_with_one_warning(change, complaint, monkeypatch):
    class Kernels(TorchEngine):
        """Torch's operations with a change."""

        name = "triton"

        def predict(self, particles, context):
            return change(super().predict(particles, context))

    made = SimpleNamespace(TritonEngine=Kernels)
    monkeypatch.setitem(sys.modules, "nmpm.emulator.engines.triton.engine", made)
    on_gpu(monkeypatch)
    emulator, state = moving(box(), energy=True), state_of(box())
    context = RolloutContext(emulator.solid(state), emulator.budget(state))
    expected = TorchEngine(emulator).predict(emulator.with_plain_padding(state), context)
    if complaint:
        with pytest.warns(UserWarning, match=f"Kernels in Triton are not used on cpu, but torch's.*{complaint}"):
            emulator.context(state)
    for _ in range(2):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert torch.equal(emulator(state).position, expected.position)
    assert find_engine(emulator, state, emulator.solid(state)).name == ("torch" if complaint else "triton")


class WrongGradient(torch.autograd.Function):
    """Of a path, larger than it is by a tenth."""

    @staticmethod
    def forward(ctx, path):
        return path.clone()

    @staticmethod
    def backward(ctx, slope):
        return 1.1 * slope


def test_trainings_are_left_to_torch_where_gradients_differ(monkeypatch):
    class Kernels(TorchEngine):
        def path(self, start, output, context):
            return WrongGradient.apply(super().path(start, output, context))

    made = SimpleNamespace(TritonTraining=Kernels)
    monkeypatch.setitem(sys.modules, "nmpm.emulator.engines.triton.training", made)
    on_gpu(monkeypatch)
    emulator, state = moving(box()).train().requires_grad_(), state_of(box())
    with pytest.warns(UserWarning, match=r"Kernels in Triton are not used on cpu.*gradients of positions differ by"):
        assert find_engine(emulator, state, emulator.solid(state)).name == "torch"


@pytest.mark.slow
def test_all_kernels_compile_for_a_gpu_that_need_not_be_there():
    pytest.importorskip("triton", reason="triton is not installed")
    command = [sys.executable, "-m", "tests.emulator.compile_kernels"]
    made = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"TRITON_INTERPRET": "0"})
    assert made.returncode == 0, made.stderr[-2000:]
    assert {line.split(":")[0] for line in made.stdout.splitlines()} >= {"flight", "flight_back", "press", "scatter"}
