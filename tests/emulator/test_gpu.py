"""The GPU's kernels, run by Triton's interpreter on a CPU, give what tensor operations give."""

import dataclasses
import os

import pytest
import torch

from nmpm.data.initial_states import lattice
from nmpm.decoders import Absolute, Acceleration, Blend
from nmpm.emulator import Emulator, rollout
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.runtimes import Triton, cuda_graph
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.processors import UNet
from nmpm.transfer import Quadratic, without_kernels
from tests.scenes import CHANNEL, box, cloud, emulator_of, with_obstacle

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported


def moving(scene, reach: float = 0.3, cells=16, frames: int = 3, **parts) -> Emulator:
    """With random weights that move particles by about `reach` cells in a frame."""
    network = UNet(width=4, depth=1, perceptron=(4,))
    return emulator_of(scene, cells, frames, processor=network, scale=reach, **parts).requires_grad_(False)


FAST = {"count": 60, "batch": 2, "speed": 0.04}
CASES = {
    "free": (box(), {}, {}),
    "one frame": (box(), {"frames": 1, "rest_speed": 0.1}, {}),
    "energy": (box(), {"energy": True}, {"speed": 0.01}),
    "at rest": (box(), {"energy": True, "rest_speed": 1.0, "reach": 0.05}, {"count": 120}),
    "obstacles": (box(obstacles=True), {"energy": True, "rest_speed": 0.3}, FAST),
    "crowded": (box(obstacles=True), {"energy": True, "density_cap": 1.0, "reach": 0.02}, FAST | {"count": 120}),
    "crowded, free": (box(), {"density_cap": 0.5, "reach": 0.02}, {"count": 120}),
    "materials": (
        box(materials=("water", "sand"), densities=(1.0, 3.0)),
        {"energy": True, "density_cap": 1.0, "rest_speed": 0.05},
        {"speed": 0.02, "batch": 2},
    ),
    "acceleration": (box(), {"decoder": Acceleration(), "energy": True}, {}),
    "absolute": (box(), {"decoder": Absolute()}, {}),
    "blend, gravity differs": (
        box(gravity=None, gravity_varies=True),
        {"decoder": Blend(), "energy": True, "rest_speed": 0.1},
        {"batch": 2},
    ),
    "periodic": (box(**CHANNEL), {"energy": True, "rest_speed": 0.2, "cells": (16, 14)}, {"count": 120}),
}


def state_of(scene, **motion) -> Particles:
    """A cloud, some of it padded, where there are obstacles with a wall of two cells; gravity may differ."""
    state = cloud(scene, **{"speed": 0.005} | motion)
    state.mask[:, -3:] = False
    if scene.obstacles:
        state = with_obstacle(state, lattice(((0.49, 0.61), (0.2, 0.6)), 0.02))
    gravity = torch.tensor([[0.0, 2e-4], [-3e-4, 1e-4]])[: len(state.position)]
    return dataclasses.replace(state, gravity=gravity) if scene.gravity_varies else state


def run_again(function, _):
    """A stand-in for the GPU's recorder."""
    made = function()

    def replay():
        again = function()
        made.position.copy_(again.position)
        made.velocity.copy_(again.velocity)

    return replay, made


@pytest.fixture
def triton(monkeypatch, device):
    """Lets emulators take the runtime; without a GPU in Triton's interpreter, and without a graph."""
    pytest.importorskip("triton", reason="triton is not installed")
    from nmpm.emulator.engines.triton import engine

    monkeypatch.setattr(engine, "_BLOCK", 64)  # more than one program for each scene
    if device.type != "cuda":
        if torch.cuda.is_available():
            pytest.skip("kernels are compiled for the GPU: --device cuda")
        monkeypatch.setattr(Triton, "unsupported_reason", lambda *_: "")
        monkeypatch.setattr(cuda_graph, "record", run_again)


@pytest.mark.usefixtures("triton")
@pytest.mark.parametrize("name", CASES)
def test_bundles_are_those_of_tensor_operations(name, device):
    scene, form, motion = CASES[name]
    emulator, state = moving(scene, **form).to(device), state_of(scene, **motion).to(device)
    with torch.no_grad():
        context = emulator.context(state)
        for _ in range(2):
            there = emulator.with_runtime("triton")(state, context)
            here = TorchEngine(emulator).predict(state, context)
            real = state.mask
            gap = (there.position - here.position).abs().amax((1, 3)) / emulator.grid.spacing[0]
            assert gap[real].max() < 1e-4
            torch.testing.assert_close(there.velocity[real], here.velocity[real], rtol=1e-3, atol=1e-6)
            state = here.state_after(state)


@pytest.mark.usefixtures("triton")
def test_rollouts_go_on_from_states_of_any_size_and_precision(device):
    emulator = moving(box(), energy=True).to(device)
    for count in (60, 1, 60):
        state = cloud(box(), count, seed=count).to(device)
        for given in (state, state.double()):
            with without_kernels():
                expected = rollout(emulator, given, 6)
            predicted = rollout(emulator.with_runtime("triton"), given, 6)
            assert predicted.dtype == expected.dtype
            torch.testing.assert_close(predicted, expected, rtol=0, atol=1e-4 * emulator.grid.spacing[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda emulator: emulator, "needs a CUDA GPU; the model is on cpu"),
        (lambda emulator: emulator.to("cuda"), "needs Triton"),
        (lambda _: moving(box(3)), "has no kernels for three dimensions: use cuda-graph or eager"),
        (Emulator.double, "torch.float64"),
        (lambda _: moving(box(), bounds="reflect"), "bounds: reflect"),
        (lambda _: moving(box(), transfer=Quadratic()), "the transfers Nearest and Quadratic"),
        (lambda _: moving(box(evolving=("heat",))), "fields"),
    ],
    ids=["cpu", "no Triton", "3-D", "float64", "bounds", "transfer", "fields"],
)
def test_what_the_kernels_do_not_take_is_refused(change, reason, monkeypatch):
    monkeypatch.setattr(Emulator, "to", lambda emulator, _: emulator)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    emulator = change(moving(box()))
    if "cpu" not in reason:
        monkeypatch.setattr(Emulator, "device", torch.device("cuda"))
    with pytest.raises(ConfigError, match=f"The runtime triton .*{reason}"):
        emulator.with_runtime("triton")
