"""What runs where: tables of the features that engines, recordings, runtimes and exported files may take.

The torch engine computes everything, and the runtime eager every network; the others are faster, and each names those
features that it takes. `Emulator.explain` and the documentation's page "What runs where" are made of these tables.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Generic, TypeVar

import torch
from torch import Tensor

from nmpm._support.messages import install
from nmpm.emulator.engines.engine import EngineForm, is_autocast
from nmpm.emulator.engines.numba.parameters import DECODERS, NODES
from nmpm.grid import Grid
from nmpm.particles import Particles, scene_volumes
from nmpm.transfer import Nearest, Quadratic, is_default, kernels_are_on

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.emulator.recipe import EmulatorRecipe

T = TypeVar("T")


@dataclass(frozen=True)
class Rule(Generic[T]):
    """A feature, whether a model or call has it, and what to do where it is not taken."""

    feature: str
    holds: Callable[[T], bool]
    mend: str = ""


# Beside the kernels torch's strided 3-D convolutions in bfloat16 sometimes got weights' gradients of unset memory
# (torch 2.13, CPU with AVX-512), which they do not beside tensor operations: no trainings in three dimensions.
# Subclasses of transfers and decoders may do something else, so exactly these count.
MODELS: tuple[Rule[EmulatorRecipe], ...] = (
    Rule("one dimension", lambda model: model.scene.dim == 1),
    Rule("three dimensions", lambda model: model.scene.dim == 3),
    Rule("fields", lambda model: bool(model.scene.fields)),
    Rule("obstacles that move", lambda model: model.scene.moving_obstacles),
    Rule("rest beside open axes", lambda model: "open" in model.scene.boundary and model.constraints.rest_speed > 0),
    Rule("the transfers Nearest and Quadratic", lambda model: type(model.transfer) in (Nearest, Quadratic)),
    Rule("other transfers", lambda model: type(model.transfer) not in NODES),
    Rule("another package's decoder", lambda model: type(model.decoder) not in DECODERS),
    Rule("bounds: reflect", lambda model: model.constraints.bounds == "reflect"),
    Rule("bounds: error", lambda model: model.constraints.bounds == "error"),
    Rule("a domain too far from the origin for float32", lambda model: not model.grid.resolves(torch.float32)),
)

CALLS: tuple[Rule[Call], ...] = (
    Rule("a CPU", lambda call: call.device == "cpu"),
    Rule("a CUDA GPU", lambda call: call.device == "cuda"),
    Rule("other devices", lambda call: call.device not in ("cpu", "cuda")),
    Rule("rollouts", lambda call: not call.emulator.training),
    Rule("trainings", lambda call: call.emulator.training),
    Rule("float64", lambda call: not call.is_float32),
    Rule("moving obstacles in the state", lambda call: call.particles.obstacle_velocity is not None),
    Rule("sizes of particles", lambda call: call.particles.volume is not None),
    Rule("several sizes in a scene", lambda call: call.sizes_differ),
    Rule("gradients of gravity, obstacles or numbers of a scene", lambda call: _need_gradients(call.surroundings)),
    Rule("gradients of a rollout", lambda call: _need_gradients(call.evolving)),
    Rule("a recorded training step, which moves its grid", lambda call: type(call.emulator.grid) is not Grid),
    Rule("graphs that torch.compile traces", lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels", lambda _: not kernels_are_on()),
    Rule("deterministic algorithms", lambda _: torch.are_deterministic_algorithms_enabled()),
)

RECORDINGS: tuple[Rule[Call], ...] = (
    Rule("devices other than a CUDA GPU", lambda call: call.device != "cuda"),
    Rule("the runtimes openvino and windows", lambda call: not call.emulator.runtime.recordable),
    Rule("trainings (`--model.record true` records whole steps)", lambda call: call.emulator.training),
    Rule("bounds: error", lambda call: call.emulator.constraints.bounds == "error"),
    Rule("gradients", lambda call: _need_gradients(call.inputs)),
    Rule("autocast", lambda call: is_autocast(call.device)),
    Rule("graphs that torch.compile traces", lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels and scatter_backend", lambda _: not is_default()),
    Rule("calls within a CUDA graph that the caller records", lambda call: call.is_recorded),
)
"""What calls that are recorded as CUDA graphs cannot have, whichever engine computes them."""

NETWORKS: tuple[Rule[Emulator], ...] = (
    Rule(
        "machines without OpenVINO", lambda _: importlib.util.find_spec("openvino") is None, install("openvino")
    ),
    Rule(
        "models on other devices than a CPU", lambda model: model.device.type != "cpu",
        "move it to the CPU, or use eager",
    ),
    Rule(
        "networks in other precisions than float32 and bfloat16",
        lambda model: model.network_precision not in (torch.float32, torch.bfloat16), "use eager",
    ),
    Rule(
        "networks that may see the whole grid, of no known radius",
        lambda model: getattr(model.processor, "radius", None) is None, "use eager",
    ),
)  # fmt: skip
"""What the runtimes beside eager run: all of them without gradients alone."""

_FREE = "export with --free, or use `emulator.unconstrained()`"
EXPORTS: tuple[Rule[Emulator], ...] = (
    Rule("fields", lambda m: bool(m.scene.fields), "use it in Python, or train one with data.fields=[]"),
    Rule("obstacles that move", lambda model: model.scene.moving_obstacles, "use it in Python"),
    Rule("open axes", lambda model: "open" in model.scene.boundary, "use it in Python"),
    Rule("bounds: error", lambda model: model.constraints.bounds == "error", _FREE),
)  # fmt: skip
"""What exported files of a call ("step"), the network alone and the obstacles' cells ("solid") carry."""

TRAINING_ERRORS: tuple[Rule[PositionPair], ...] = (
    Rule("one and three dimensions", lambda pair: pair.grid.dim != 2),
    Rule("other devices than a CPU, and float64", lambda pair: not pair.is_on_cpu),
    Rule("gradients of the true positions", lambda pair: pair.target.requires_grad),
    Rule("graphs that torch.compile traces", lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels", lambda _: not kernels_are_on()),
)
"""What the kernels of a training's position and density errors do not compute."""

TRIED: Mapping[str, str] = MappingProxyType(
    {
        "torch": "every test, on CPUs; an NVIDIA H200 (torch 2.11, November 2026)",
        "numba": "every test, on CPUs",
        "numba training": "every test, on CPUs",
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


def takes(rules: Iterable[Rule[T]], subject: T, features: Set[str] = frozenset()) -> bool:
    """Whether a model or a call has none of the features of some rules but these."""
    return not any(rule.feature not in features and rule.holds(subject) for rule in rules)


def lacks(rules: Iterable[Rule[T]], subject: T, features: Set[str] = frozenset()) -> list[str]:
    """The features of a model or a call beside these."""
    return [rule.feature for rule in rules if rule.feature not in features and rule.holds(subject)]


def refusal(rules: Iterable[Rule[T]], subject: T, features: Set[str] = frozenset()) -> str:
    """The first feature of a model beside these, and what to do; empty if there is none."""
    rule = next((rule for rule in rules if rule.feature not in features and rule.holds(subject)), None)
    return "" if rule is None else f"{rule.feature}: {rule.mend}"


def call_form(emulator: Emulator, particles: Particles, solid: Tensor) -> EngineForm | None:
    """The form of the emulator's engine that computes a call; None where torch's operations do."""
    call = Call(emulator, particles, solid)
    return next((form for form in emulator.engine_forms if takes(CALLS, call, form.features)), None)


def _need_gradients(tensors: Iterable[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(values.requires_grad for values in tensors)
