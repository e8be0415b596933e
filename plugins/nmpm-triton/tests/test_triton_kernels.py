"""The GPU's kernels, run by Triton's interpreter on a CPU, give what tensor operations give."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="triton is not installed")
pytest.importorskip("nmpm_triton", reason="nmpm-triton is not installed: pip install -e plugins/nmpm-triton")

from nmpm_triton import launch
from nmpm_triton.engine import TritonEngine
from nmpm_triton.training import TritonTraining

from nmpm.backends import ENGINES
from nmpm.decoders import Absolute, Acceleration, Blend, Flip
from nmpm.emulator import Emulator, rollout
from nmpm.emulator.engines import find_engine, graphs, rules
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.rollouts import recomputed
from nmpm.particles import Particles, lattice
from nmpm.processors import UNet
from nmpm.training import recorded_steps
from nmpm.zoo.optimization import optimize
from tests.scenes import CHANNEL, box, cloud, emulator_of, window_of, with_obstacle

pytestmark = pytest.mark.slow


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
    monkeypatch.setattr(launch, "BLOCK", 32)  # more than one program for each scene
    if device.type != "cuda":
        if torch.cuda.is_available():
            pytest.skip("kernels are compiled for the GPU: --device cuda")
        monkeypatch.setattr(rules.Call, "device", "cuda")
        monkeypatch.setattr(graphs, "RECORDINGS", (rules.Rule("a stand-in for a GPU", lambda _: True),))


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("name", CASES)
def test_bundles_are_those_of_tensor_operations(name, device, monkeypatch):
    scene, form, motion = CASES[name]
    emulator, state = moving(scene, **form).to(device), state_of(scene, **motion).to(device)
    for most in (launch.ONE_PROGRAM, 0):  # a scene in one program, and in several
        monkeypatch.setattr(launch, "ONE_PROGRAM", most)
        with torch.no_grad():
            context = emulator.context(state)
            there = TritonEngine(emulator).predict(state, context)
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
    path, gradients = gradients_of(TritonTraining(emulator), emulator, state)
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
        _, gradients = gradients_of(TritonTraining(emulator), emulator, state)
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
            expected = rollout(emulator, given, 4)
            predicted = rollout(emulator.with_engine("triton"), given, 4)
            assert predicted.dtype == expected.dtype
            torch.testing.assert_close(predicted, expected, rtol=0, atol=1e-4 * emulator.grid.spacing[0])


@pytest.mark.usefixtures("triton")
def test_the_engine_is_registered_compared_and_used_where_it_is_asked_for(device):
    assert "triton" in ENGINES
    emulator, state = moving(box(), energy=True).to(device), state_of(box()).to(device)
    assert find_engine(emulator, state, emulator.solid(state)).name == "torch"
    chosen = optimize(emulator, "triton")
    assert find_engine(chosen, state, emulator.solid(state)).name == "triton"
    assert chosen.explain().splitlines()[1:3] == [
        "  rollouts   Triton kernels", "  trainings  Triton kernels with gradients",
    ]  # fmt: skip
    trained = moving(box(materials=("water", "sand"))).train().requires_grad_().to(device).with_engine("triton")
    state = state_of(trained.scene).to(device)
    recomputed(trained, state, trained.context(state)).position.sum().backward()
    assert find_engine(trained, state, trained.solid(state)).name == "triton training"


def test_all_kernels_compile_for_a_gpu_that_need_not_be_there():
    command = [sys.executable, str(Path(__file__).with_name("compile_kernels.py"))]
    made = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"TRITON_INTERPRET": "0"})
    assert made.returncode == 0, made.stderr[-2000:]
    assert {line.split(":")[0] for line in made.stdout.splitlines()} >= {"flight", "flight_back", "press", "scatter"}
