"""Networks by OpenVINO: torch's results to rounding, nothing sent, no signal handler harmed."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
import torch
from scenes import box, cloud

from nmpm.emulator import Emulator, EmulatorRecipe
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.runtimes import OpenVINO
from nmpm.errors import ConfigError
from nmpm.processors import Axial, GridProcessor, Pointwise, UNet

if find_spec("openvino") is None:  # importing it would report to its makers
    pytest.skip("openvino is not installed", allow_module_level=True)

SMALL = UNet(width=4, depth=1, perceptron=(4,))


def emulator_of(scene=None, processor=SMALL, cells=8, **constraints) -> Emulator:
    torch.manual_seed(0)
    recipe = EmulatorRecipe(scene or box(), cells, 3, processor=processor, constraints=Constraints(**constraints))
    return recipe.build().eval().requires_grad_(False)


def grid_of(emulator: Emulator, batch: int = 1, seed: int = 0) -> torch.Tensor:
    shape = (batch, len(emulator.scene.input_channels), *emulator.grid.shape)
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def pair() -> tuple[Emulator, Emulator]:
    """An emulator by torch, and by OpenVINO."""
    emulator = emulator_of()
    return emulator, emulator.with_runtime("openvino")


@pytest.mark.parametrize(
    ("scene", "cells", "processor"),
    [
        (box(), (12, 8), SMALL),
        (box(3, materials=("water", "sand")), (8, 4, 6), SMALL),
        (box(), 8, Axial(width=8, layers=1, heads=2, patch=4)),
    ],
    ids=["UNet", "3-D", "Axial"],
)
def test_fields_are_those_of_torch(scene, cells, processor):
    network = emulator_of(scene, processor, cells)
    grid, runtime = grid_of(network, batch=2), OpenVINO()
    for layout in (grid, grid.movedim(1, -1).contiguous().movedim(-1, 1)):
        fields = runtime.fields(network.processor, layout, torch.float32)
        torch.testing.assert_close(fields, network.processor(layout), rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_new_weights_count():
    emulator = emulator_of(processor=Pointwise())
    quick, state = emulator.with_runtime("openvino"), cloud(box())
    before = quick(state).position
    for weight in emulator.parameters():
        weight.mul_(2)
    again = emulator(state).position
    assert (again - before).abs().max() > 1e-3
    torch.testing.assert_close(quick(state).position, again, rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore:This processor has no bfloat16")
def test_the_network_runs_in_its_own_precision():
    plain, state = emulator_of(processor=Pointwise()), cloud(box())
    emulator = plain.with_network(torch.bfloat16)
    quick = emulator.with_runtime("openvino")
    assert quick.network_precision == torch.bfloat16
    spacing = torch.tensor(emulator.grid.spacing)
    assert ((quick(state).position - emulator(state).position) / spacing).abs().max() < 0.1
    converted = plain.with_runtime("openvino").with_network(torch.bfloat16)
    assert isinstance(converted.runtime, OpenVINO)
    assert torch.equal(converted(state).position, quick(state).position)


# ---- what it cannot do


def test_gradients_and_training_are_refused(pair):
    quick, state = pair[1], cloud(box())
    state.velocity.requires_grad_()
    with pytest.raises(ConfigError, match="openvino has no gradients"):
        quick(state)
    with torch.no_grad():
        quick(state)
    with pytest.raises(ConfigError, match="openvino has no gradients"):
        emulator_of().with_runtime("openvino").train()(cloud(box()))


class Spectral(GridProcessor):
    """Has complex intermediate values."""

    def forward(self, grid):
        return torch.fft.rfft2(grid).abs().unsqueeze(1)


def test_networks_that_it_cannot_run_are_named():
    with pytest.raises(ConfigError, match="OpenVINO cannot run Spectral: use the runtime eager"):
        OpenVINO().fields(Spectral().eval(), torch.zeros(1, 3, 8, 8), torch.float32)


def test_other_devices_and_types_are_refused(pair):
    emulator, quick = pair
    with pytest.raises(ConfigError, match=r"runs on CPUs; the model is on meta\."):
        emulator_of().to("meta").with_runtime("openvino")
    with pytest.raises(ConfigError, match=r"float32 or bfloat16, not in torch\.float64"):
        emulator_of().double().with_runtime("openvino")
    with pytest.raises(ConfigError, match=r"not on meta in torch\.float32"):
        quick.runtime.fields(quick.processor, grid_of(emulator).to("meta"), torch.float32)


def test_a_missing_package_is_named_with_its_installation(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(ConfigError, match=r'not installed: pip install "nmpm\[openvino\]"'):
        emulator_of().with_runtime("openvino")
    with pytest.raises(ConfigError, match=r'not installed: pip install "nmpm\[openvino\]"'):
        OpenVINO().fields(emulator_of().processor, grid_of(emulator_of()), torch.float32)


# ---- the process around it

SCRIPT = """
import faulthandler, os, signal, sys
faulthandler.enable()
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells make it ignored in background jobs
import torch
from scenes import box, cloud
from nmpm.emulator import EmulatorRecipe, stream
from nmpm.emulator.runtimes.openvino import SignalStack
from nmpm.processors import Pointwise
from nmpm.transfer import without_kernels

def signal_stack():
    import ctypes
    stack = SignalStack()
    ctypes.CDLL(None).sigaltstack(None, ctypes.byref(stack))
    return stack.pointer, stack.flags, stack.size

before = signal_stack()
emulator = EmulatorRecipe(box(), 8, 3, processor=Pointwise()).build().eval().requires_grad_(False)
try:
    with without_kernels():  # kernels would be compiled first
        for number, _ in enumerate(stream(emulator.with_runtime("openvino"), cloud(box()), 300)):
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
    path = os.pathsep.join([os.path.dirname(os.path.dirname(__file__)), *sys.path])
    own = os.environ | {"HOME": str(tmp_path), "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=own, timeout=120)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.splitlines() == ["kept True", "telemetry []", "interrupted 5"]
    assert not (tmp_path / "intel").exists()  # where the telemetry package keeps the user's identity
