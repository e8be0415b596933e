"""Faster runtimes of trained models are compared with torch before they are used."""

import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import ClassVar

import pytest
import torch

from nmpm.backends import ENGINES
from nmpm.emulator import Bundle
from nmpm.emulator.engines import find_engine
from nmpm.emulator.engines.engine import EngineForm
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.runtimes import Eager, OpenVINO, Runtime, Windows
from nmpm.errors import ConfigError
from nmpm.registry import Registry
from nmpm.transfer import without_kernels
from nmpm.zoo import Pretrained, optimization
from tests.scenes import box, emulator_of


@pytest.fixture
def model(small) -> Iterator[Pretrained]:
    with without_kernels():  # kernels would be compiled first
        yield Pretrained(small.requires_grad_(False), {"name": "small"})


class Wrong(Runtime):
    """Computes something else."""

    name = "openvino"

    def fields(self, network, grid, precision):
        return 2 * network(grid) + 0.1


class Slow(Eager):
    """Torch with a pause."""

    name = "openvino"

    def fields(self, network, grid, precision):
        time.sleep(0.05)
        return super().fields(network, grid, precision)


def use(monkeypatch, **runtimes) -> None:
    for module in ("nmpm.emulator.runtimes", "nmpm.zoo.optimization"):
        monkeypatch.setattr(f"{module}.RUNTIMES", Registry("none", "runtime", runtimes))


def test_the_fastest_as_measured_is_taken(model, monkeypatch):
    use(monkeypatch, openvino=Slow, eager=Eager)
    assert model.optimized().emulator.runtime.name == "eager"


def test_runtimes_that_pay_in_some_scenes_are_tried_in_a_given_one(model, monkeypatch):
    seen = []
    monkeypatch.setattr(optimization, "_seconds", lambda emulator, state: seen.append(state) or len(seen))
    use(monkeypatch, windows=Windows, eager=Eager)
    assert model.optimized().emulator.runtime.name == "eager"
    state = model.example(count=50)
    assert model.optimized(state=state).emulator.runtime.name == "windows"
    assert all(torch.equal(one.position, state.position) for one in seen)


def test_what_runs_here_is_taken_and_checked(model, caplog, monkeypatch):
    if find_spec("openvino") is None:  # importing it would report to its makers
        pytest.skip("openvino is not installed")
    caplog.set_level(logging.INFO, "nmpm")
    monkeypatch.setattr(optimization, "_seconds", lambda emulator, _: not isinstance(emulator.runtime, OpenVINO))
    quick = model.optimized()
    assert isinstance(quick.emulator.runtime, OpenVINO)
    assert isinstance(model.emulator.runtime, Eager)
    assert "openvino, float32: within" in caplog.text
    state = model.example(count=50)
    torch.testing.assert_close(quick.rollout(state, 8), model.rollout(state, 8), rtol=0, atol=1e-4)
    assert model.optimized("eager", "bfloat16").emulator.network_precision == torch.bfloat16
    with pytest.raises(ConfigError, match="float32 or bfloat16, not in 'float61'"):
        model.optimized("openvino", "float61")
    with pytest.raises(ConfigError, match="does not run models on other devices than a CPU"):
        model.to("meta").optimized("openvino")


def test_without_a_faster_one_it_is_torch(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert isinstance(model.optimized().emulator.runtime, Eager)
    assert isinstance(model.optimized("eager").emulator.runtime, Eager)
    with pytest.raises(ConfigError, match=r"pip install -e \"\.\[openvino\]\""):
        model.optimized("openvino")
    with pytest.warns(UserWarning, match="runtime cuda-graph is now part of eager"):
        assert isinstance(model.optimized("cuda-graph").emulator.runtime, Eager)
    with pytest.raises(ConfigError, match="No runtime is called 'fast'"):
        model.optimized("fast")


def test_a_runtime_that_computes_something_else_is_refused(model, monkeypatch):
    use(monkeypatch, openvino=Wrong, eager=Eager)
    with pytest.raises(ConfigError, match="openvino computes something else than torch: positions after one bundle"):
        model.optimized("openvino")
    assert isinstance(model.optimized().emulator.runtime, Eager)


class Kernels(TorchEngine):
    """Torch's operations with a change of the bundles, of another package."""

    change: ClassVar[Callable[[Bundle], Bundle]] = staticmethod(lambda bundle: bundle)

    def predict(self, particles, context):
        return self.change(super().predict(particles, context))


@pytest.fixture
def kernels(monkeypatch) -> type[Kernels]:
    """The engine "kernels", registered for rollouts on CPUs."""
    form = EngineForm(
        "kernels", "Kernels", frozenset({"a CPU", "rollouts", "the transfers Nearest and Quadratic"}), Kernels
    )
    monkeypatch.setattr(ENGINES, "plugins", {"kernels": None})
    monkeypatch.setitem(ENGINES._loaded, "kernels", (form,))
    return Kernels


def test_an_engine_of_another_package_is_used_where_it_is_asked_for(small, kernels):
    model = Pretrained(small.requires_grad_(False), {"name": "small"})
    state = model.example(count=50)
    solid = model.emulator.solid(state)
    quick = model.optimized("kernels")
    assert isinstance(find_engine(quick.emulator, state, solid), kernels)
    assert quick.emulator.explain().splitlines()[1:3] == [
        "  rollouts   Kernels", "  trainings  torch's operations",
    ]  # fmt: skip
    assert find_engine(model.emulator, state, solid).name == "numba"
    assert 'further    `optimized("kernels")`' in model.emulator.explain()
    assert model.optimized("torch").emulator.engine == "torch"
    with pytest.raises(ConfigError, match="The engine kernels does not take three dimensions"):
        Pretrained(emulator_of(box(3), 8), {}).optimized("kernels")
    with pytest.raises(ConfigError, match="The engine kernels does not take other devices: use the runtime eager"):
        model.to("meta").optimized("kernels")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda bundle: 1 / 0, r"The engine kernels fails here \(ZeroDivisionError: division by zero\)"),
        (lambda b: dataclasses.replace(b, position=b.position + 0.01), r"after one bundle differ by \d.* cells, where"),
        (lambda b: dataclasses.replace(b, position=b.position * torch.nan), "after one bundle differ by nan cells"),
    ],
    ids=["fail", "differ", "are not finite"],
)
def test_an_engine_that_fails_or_computes_something_else_is_refused(small, kernels, change, complaint, monkeypatch):
    monkeypatch.setattr(kernels, "change", staticmethod(change))
    with pytest.raises(ConfigError, match=complaint):
        Pretrained(small.requires_grad_(False), {}).optimized("kernels")
