"""What runs where: tables of the features that engines, recordings, runtimes and exported files take.

The torch engine computes everything, and the runtime eager every network; the others are faster, and take what the
tables give to them. `Emulator.explain` and the documentation's page "What runs where" are made of these tables.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Generic, TypeVar

import torch
from torch import Tensor

from nmpm._support.messages import install
from nmpm.emulator.engines.engine import is_autocast
from nmpm.emulator.engines.numba.parameters import DECODERS, NODES
from nmpm.grid import Grid
from nmpm.particles import Particles, scene_volumes
from nmpm.transfer import Nearest, Quadratic, is_default, kernels_are_on

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.emulator.recipe import EmulatorRecipe

NUMBA, TRITON = ("numba", "numba training"), ("triton", "triton training")
FASTER = (*NUMBA, *TRITON)
"""Engines beside "torch", by name; of those that take a call the first one computes it."""

T = TypeVar("T")


@dataclass(frozen=True)
class Rule(Generic[T]):
    """A feature, who takes it beside torch, whether a model or call has it, and what to do where it is not taken."""

    feature: str
    engines: tuple[str, ...]
    holds: Callable[[T], bool]
    mend: str = ""


@cache
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None


# Beside the kernels torch's strided 3-D convolutions in bfloat16 sometimes got weights' gradients of unset memory
# (torch 2.13, CPU with AVX-512), which they do not beside tensor operations: no trainings in three dimensions.
# Subclasses of transfers and decoders may do something else, so exactly these count.
MODELS: tuple[Rule[EmulatorRecipe], ...] = (
    Rule("one dimension", (), lambda model: model.scene.dim == 1),
    Rule("three dimensions", ("numba",), lambda model: model.scene.dim == 3),
    Rule("fields", NUMBA, lambda model: bool(model.scene.fields)),
    Rule("obstacles that move", NUMBA, lambda model: model.scene.moving_obstacles),
    Rule("rest beside open axes", (), lambda m: "open" in m.scene.boundary and m.constraints.rest_speed > 0),
    Rule("the transfers Nearest and Quadratic", ("numba",), lambda model: type(model.transfer) in (Nearest, Quadratic)),
    Rule("other transfers", (), lambda model: type(model.transfer) not in NODES),
    Rule("another package's decoder", (), lambda model: type(model.decoder) not in DECODERS),
    Rule("bounds: reflect", ("numba",), lambda model: model.constraints.bounds == "reflect"),
    Rule("bounds: error", (), lambda model: model.constraints.bounds == "error"),
    Rule("a domain too far from the origin for float32", (), lambda model: not model.grid.resolves(torch.float32)),
)

CALLS: tuple[Rule[Call], ...] = (
    Rule("a CPU", NUMBA, lambda call: call.device == "cpu"),
    Rule("a CUDA GPU", TRITON, lambda call: call.device == "cuda"),
    Rule("machines without Triton", NUMBA, lambda _: not _has_triton()),
    Rule("other devices", (), lambda call: call.device not in ("cpu", "cuda")),
    Rule("rollouts", ("numba", "triton"), lambda call: not call.emulator.training),
    Rule("trainings", ("numba training", "triton training"), lambda call: call.emulator.training),
    Rule("float64", (), lambda call: not call.is_float32),
    Rule("moving obstacles in the state", NUMBA, lambda call: call.particles.obstacle_velocity is not None),
    Rule("sizes of particles", FASTER, lambda call: call.particles.volume is not None),
    Rule("several sizes in a scene", ("numba", *TRITON), lambda call: call.sizes_differ),
    Rule("gradients of gravity, obstacles or numbers of a scene", (), lambda call: _need_gradients(call.surroundings)),
    Rule("gradients of a rollout", ("numba training", "triton training"), lambda call: _need_gradients(call.evolving)),
    Rule(
        "a recorded training step, which moves its grid",
        ("triton training",),
        lambda c: type(c.emulator.grid) is not Grid,
    ),
    Rule("graphs that torch.compile traces", (), lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels", (), lambda _: not kernels_are_on()),
    Rule("deterministic algorithms", NUMBA, lambda _: torch.are_deterministic_algorithms_enabled()),
)

RECORDINGS: tuple[Rule[Call], ...] = (
    Rule("devices other than a CUDA GPU", (), lambda call: call.device != "cuda"),
    Rule("the runtimes openvino and windows", (), lambda call: not call.emulator.runtime.recordable),
    Rule("trainings (`--model.record true` records whole steps)", (), lambda call: call.emulator.training),
    Rule("bounds: error", (), lambda call: call.emulator.constraints.bounds == "error"),
    Rule("gradients", (), lambda call: _need_gradients(call.inputs)),
    Rule("autocast", (), lambda call: is_autocast(call.device)),
    Rule("graphs that torch.compile traces", (), lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels and scatter_backend", (), lambda _: not is_default()),
    Rule("calls within a CUDA graph that the caller records", (), lambda call: call.is_recorded),
)
"""What calls that are recorded as CUDA graphs cannot have, whichever engine computes them."""

RUNTIMES: tuple[Rule[Emulator], ...] = (
    Rule(
        "machines without OpenVINO", ("windows",), lambda _: importlib.util.find_spec("openvino") is None,
        install("openvino"),
    ),
    Rule(
        "models on other devices than a CPU", ("windows",), lambda model: model.device.type != "cpu",
        "move it to the CPU, or use eager",
    ),
    Rule(
        "networks in other precisions than float32 and bfloat16", ("windows",),
        lambda model: model.network_precision not in (torch.float32, torch.bfloat16), "use eager",
    ),
    Rule(
        "networks that may see the whole grid, of no known radius", ("openvino",),
        lambda model: getattr(model.processor, "radius", None) is None, "use eager",
    ),
)  # fmt: skip
"""What the runtimes beside eager run: all of them without gradients alone."""

_FREE = "export with --free, or use `emulator.unconstrained()`"
EXPORTS: tuple[Rule[Emulator], ...] = (
    Rule("fields", (), lambda m: bool(m.scene.fields), "use it in Python, or train one with data.fields=[]"),
    Rule("obstacles that move", (), lambda model: model.scene.moving_obstacles, "use it in Python"),
    Rule("open axes", (), lambda model: "open" in model.scene.boundary, "use it in Python"),
    Rule("bounds: error", ("network", "solid"), lambda model: model.constraints.bounds == "error", _FREE),
)  # fmt: skip
"""What exported files of a call ("step"), the network alone and the obstacles' cells ("solid") carry."""

TRAINING_ERRORS: tuple[Rule[PositionPair], ...] = (
    Rule("one and three dimensions", (), lambda pair: pair.grid.dim != 2),
    Rule("other devices than a CPU, and float64", (), lambda pair: not pair.is_on_cpu),
    Rule("gradients of the true positions", (), lambda pair: pair.target.requires_grad),
    Rule("graphs that torch.compile traces", (), lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels", (), lambda _: not kernels_are_on()),
)
"""What the kernels of a training's position and density errors do not compute."""

TRIED: Mapping[str, str] = MappingProxyType(
    {
        "torch": "every test, on CPUs; an NVIDIA H200 (torch 2.11, November 2026)",
        "numba": "every test, on CPUs",
        "numba training": "every test, on CPUs",
        "triton": "Triton's interpreter on CPUs; no GPU yet, so that the first call compares a bundle with torch",
        "triton training": "Triton's interpreter on CPUs; no GPU yet, so that the first step compares gradients, too",
        "CUDA graphs": "tests with a stand-in; an NVIDIA H200 (torch engine, without fields, November 2026)",
        "openvino": "tests on CPUs",
        "windows": "tests on CPUs",
    }
)
"""Where engines, recordings and runtimes have run."""


@dataclass(frozen=True)
class Call:
    """A call of an emulator, among solids (B, C_solid, *S)."""

    emulator: Emulator
    particles: Particles
    solid: Tensor

    @property
    def device(self) -> str:
        return self.particles.position.device.type

    @property
    def surroundings(self) -> tuple[Tensor, ...]:
        """Gravity, solids and numbers of the scenes."""
        state = self.particles
        numbers = (values for values in state.fields.values() if values.shape[1] == 1)
        moving = () if state.obstacle_velocity is None else (state.obstacle_velocity,)
        return (state.gravity, self.solid, *moving, *numbers)

    @property
    def is_float32(self) -> bool:
        given = self.particles.position, self.particles.velocity, self.particles.gravity
        return self.emulator.precision == torch.float32 and all(each.dtype == torch.float32 for each in given)

    @property
    def evolving(self) -> Iterator[Tensor]:
        """Motion, fields and weights."""
        yield from (self.particles.position, self.particles.velocity, *self.particles.fields.values())
        yield from self.emulator.parameters()

    @property
    def inputs(self) -> Iterator[Tensor]:
        yield from (values for values in vars(self.particles).values() if isinstance(values, Tensor))
        yield self.solid
        yield from self.evolving

    @property
    def is_recorded(self) -> bool:
        return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()

    @property
    def sizes_differ(self) -> bool:
        return scene_volumes(self.particles.volume, self.particles.mask) is None


@dataclass(frozen=True)
class PositionPair:
    """Predicted and true positions on a grid, for the errors of `nmpm.training.losses`."""

    predicted: Tensor
    target: Tensor
    grid: Grid

    @property
    def is_on_cpu(self) -> bool:
        return all(x.device.type == "cpu" and x.dtype == torch.float32 for x in (self.predicted, self.target))


def model_engines(recipe: EmulatorRecipe) -> tuple[str, ...]:
    """Those of `FASTER` that compute all that a model has."""
    return tuple(name for name in FASTER if takes(name, MODELS, recipe))


def takes(engine: str, rules: Iterable[Rule[T]], subject: T) -> bool:
    """Whether an engine computes all that a model or a call has."""
    return not any(engine not in rule.engines and rule.holds(subject) for rule in rules)


def lacks(engine: str, rules: Iterable[Rule[T]], subject: T) -> list[str]:
    """The features of a model or a call that an engine does not compute."""
    return [rule.feature for rule in rules if engine not in rule.engines and rule.holds(subject)]


def refusal(engine: str, rules: Iterable[Rule[T]], subject: T) -> str:
    """The first feature that an engine does not take, and what to do; empty if there is none."""
    rule = next((rule for rule in rules if engine not in rule.engines and rule.holds(subject)), None)
    return "" if rule is None else f"{rule.feature}: {rule.mend}"


def call_engine(emulator: Emulator, particles: Particles, solid: Tensor) -> str:
    """The name of the engine that computes a call."""
    call = Call(emulator, particles, solid)
    return next((name for name in emulator.engines if takes(name, CALLS, call)), "torch")


def _need_gradients(tensors: Iterable[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(values.requires_grad for values in tensors)
