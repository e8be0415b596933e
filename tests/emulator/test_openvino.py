"""Networks by OpenVINO: torch's results to rounding, nothing sent, no signal handler harmed."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch

from nmpm.emulator import Emulator
from nmpm.emulator.runtimes import OpenVINO
from nmpm.errors import ConfigError
from nmpm.processors import Axial, GridProcessor, Pointwise, UNet
from tests.scenes import box, cloud, emulator_of

if find_spec("openvino") is None:  # importing it would report to its makers
    pytest.skip("openvino is not installed", allow_module_level=True)


def small(scene=None, processor=Pointwise(), cells=8) -> Emulator:
    return emulator_of(scene or box(), cells, 3, processor=processor).requires_grad_(False)


@pytest.mark.parametrize(
    ("scene", "cells", "processor"),
    [
        (box(3, materials=("water", "sand")), (8, 4, 6), UNet(width=4, depth=1, perceptron=(4,))),
        (box(), 8, Axial(width=8, layers=1, heads=2, patch=4)),
    ],
    ids=["UNet", "Axial"],
)
def test_fields_are_those_of_torch(scene, cells, processor):
    emulator, runtime = small(scene, processor, cells), OpenVINO()
    grid = torch.randn(2, len(scene.input_channels), *emulator.grid.shape)
    for layout in (grid, grid.movedim(1, -1).contiguous().movedim(-1, 1)):
        fields = runtime.fields(emulator.processor, layout, torch.float32)
        torch.testing.assert_close(fields, emulator.processor(layout), rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_new_weights_count():
    emulator, state = small(), cloud(box())
    quick = emulator.with_runtime("openvino")
    before = quick(state).position
    for weight in emulator.parameters():
        weight.mul_(2)
    again = emulator(state).position
    assert (again - before).abs().max() > 1e-3
    torch.testing.assert_close(quick(state).position, again, rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore:This processor has no bfloat16")
def test_the_network_runs_in_the_emulators_precision():
    plain, state = small(), cloud(box())
    emulator = plain.with_network(torch.bfloat16)
    quick = emulator.with_runtime("openvino")
    assert quick.network_precision == torch.bfloat16
    spacing = torch.tensor(emulator.grid.spacing)
    assert ((quick(state).position - emulator(state).position) / spacing).abs().max() < 0.1
    converted = plain.with_runtime("openvino").with_network(torch.bfloat16)
    assert torch.equal(converted(state).position, quick(state).position)


# ---- what it cannot do


def test_gradients_and_training_are_refused():
    quick, state = small().with_runtime("openvino"), cloud(box())
    state.velocity.requires_grad_()
    with torch.no_grad():
        quick(state)
    for emulator, particles in ((quick, state), (quick.train(), cloud(box()))):
        with pytest.raises(ConfigError, match="openvino has no gradients"):
            emulator(particles)


class Spectral(GridProcessor):
    """Has complex intermediate values."""

    def forward(self, grid):
        return torch.fft.rfft2(grid).abs().unsqueeze(1)


def test_networks_devices_and_types_that_it_does_not_take_are_named():
    with pytest.raises(ConfigError, match="OpenVINO cannot run Spectral: use the runtime eager"):
        OpenVINO().fields(Spectral().eval(), torch.zeros(1, 3, 8, 8), torch.float32)
    with pytest.raises(ConfigError, match="openvino does not run models on other devices than a CPU: move it"):
        small().to("meta").with_runtime("openvino")
    with pytest.raises(ConfigError, match="networks in other precisions than float32 and bfloat16: use eager"):
        small().double().with_runtime("openvino")


def test_a_missing_package_is_named_with_its_installation(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(ConfigError, match=r'machines without OpenVINO: pip install -e "\.\[openvino\]"'):
        small().with_runtime("openvino")


# ---- the process around it

SCRIPT = """
import faulthandler, os, signal, sys
faulthandler.enable()
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells make it ignored in background jobs
from tests.scenes import box, cloud, emulator_of
from nmpm.emulator import stream_rollout
from nmpm.emulator.runtimes.openvino import SignalStack
from nmpm.transfer import without_kernels

def signal_stack():
    import ctypes
    stack = SignalStack()
    ctypes.CDLL(None).sigaltstack(None, ctypes.byref(stack))
    return stack.pointer, stack.flags, stack.size

before = signal_stack()
emulator = emulator_of(box(), 8, 3).requires_grad_(False)
try:
    with without_kernels():  # kernels would be compiled first
        for number, _ in enumerate(stream_rollout(emulator.with_runtime("openvino"), cloud(box()), 300)):
            if number == 5:
                print("kept", signal_stack() == before)
                print("telemetry", [name for name in sys.modules if name.startswith("openvino_telemetry")])
                os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted", number)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="signal stacks are restored on Linux")
def test_an_interrupt_is_an_interrupt_and_nothing_is_sent(tmp_path):
    """Loading OpenVINO replaces the signal stack, and importing it reports to its makers, unless both are prevented."""
    environment = os.environ | {"HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.splitlines() == ["kept True", "telemetry []", "interrupted 5"]
    assert not (tmp_path / "intel").exists()  # where the telemetry package keeps the user's identity
