"""What runs where: which engine computes which feature of a model, and of a call.

The torch engine computes everything; the others are faster, and compute what the tables give to them.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Generic, TypeVar

import torch
from torch import Tensor

from nmpm.decoders import Absolute, Acceleration, Blend, Flip, Residual
from nmpm.particles import Particles, scene_volumes
from nmpm.transfer import Linear, Nearest, Quadratic
from nmpm.transfer.execution import is_default, kernels_are_on

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.emulator.recipe import EmulatorRecipe

FASTER = ("numba", "numba training", "triton")
"""Engines beside "torch", by name; of those that take a call the first one computes it."""

T = TypeVar("T")


@dataclass(frozen=True)
class Rule(Generic[T]):
    """A feature, the engines beside torch's that compute it, and whether a model, or a call, has it."""

    feature: str
    engines: tuple[str, ...]
    holds: Callable[[T], bool]


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
    def motion(self) -> tuple[Tensor, Tensor]:
        return self.particles.position, self.particles.velocity

    @property
    def is_float32(self) -> bool:
        given = (*self.motion, self.particles.gravity)
        return self.emulator.precision == torch.float32 and all(each.dtype == torch.float32 for each in given)

    @property
    def inputs(self) -> Iterator[Tensor]:
        yield from (values for values in vars(self.particles).values() if isinstance(values, Tensor))
        yield from self.particles.fields.values()
        yield self.solid
        yield from self.emulator.parameters()

    @property
    def sizes_differ(self) -> bool:
        return scene_volumes(self.particles.volume, self.particles.mask) is None


def _need_gradients(tensors: Iterable[Tensor]) -> bool:
    return torch.is_grad_enabled() and any(values.requires_grad for values in tensors)


def _is_recording() -> bool:
    return torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()


@cache
def _has_triton() -> bool:
    return importlib.util.find_spec("triton") is not None


def _is_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)


_KNOWN_DECODERS = (Absolute, Residual, Flip, Blend, Acceleration)

MODELS: tuple[Rule[EmulatorRecipe], ...] = (
    Rule("one dimension", (), lambda recipe: recipe.scene.dim == 1),
    # Beside the kernels torch's strided 3-D convolutions in bfloat16 sometimes got weights' gradients of unset memory
    # (torch 2.13, CPU with AVX-512), which they do not beside tensor operations: no training.
    Rule("three dimensions", ("numba",), lambda recipe: recipe.scene.dim == 3),
    Rule("fields", (), lambda recipe: bool(recipe.scene.fields)),
    Rule("obstacles that move", (), lambda recipe: recipe.scene.moving_obstacles),
    Rule("rest beside open axes", (), lambda r: "open" in r.scene.boundary and r.constraints.rest_speed > 0),
    # Subclasses may do something else, so exactly these count.
    Rule(
        "the transfers Nearest and Quadratic", ("numba",), lambda recipe: type(recipe.transfer) in (Nearest, Quadratic)
    ),
    Rule("other transfers", (), lambda recipe: type(recipe.transfer) not in (Nearest, Linear, Quadratic)),
    Rule("another package's decoder", (), lambda recipe: type(recipe.decoder) not in _KNOWN_DECODERS),
    Rule("bounds: reflect", ("numba",), lambda recipe: recipe.constraints.bounds == "reflect"),
    Rule("bounds: error", (), lambda recipe: recipe.constraints.bounds == "error"),
    Rule("a domain too far from the origin for float32", (), lambda recipe: not recipe.grid.resolves(torch.float32)),
)

CALLS: tuple[Rule[Call], ...] = (
    Rule("a CPU", ("numba", "numba training"), lambda call: call.device == "cpu"),
    Rule("a CUDA GPU", ("triton",), lambda call: call.device == "cuda"),
    Rule("machines without Triton", ("numba", "numba training"), lambda _: not _has_triton()),
    Rule("other devices", (), lambda call: call.device not in ("cpu", "cuda")),
    Rule("rollouts", ("numba", "triton"), lambda call: not call.emulator.training),
    Rule("trainings", ("numba training",), lambda call: call.emulator.training),
    Rule("float64", (), lambda call: not call.is_float32),
    Rule("moving obstacles in the state", (), lambda call: call.particles.obstacle_velocity is not None),
    Rule("sizes of particles", ("numba training",), lambda call: call.particles.volume is not None),
    Rule("several sizes in a scene", (), lambda call: call.sizes_differ),
    Rule("gradients of gravity or obstacles", (), lambda call: _need_gradients((call.particles.gravity, call.solid))),
    Rule(
        "gradients of a rollout", ("numba training",),
        lambda call: _need_gradients((*call.motion, *call.emulator.parameters())),
    ),
    Rule("graphs that torch.compile traces", (), lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels", (), lambda _: not kernels_are_on()),
    Rule(
        "deterministic algorithms", ("numba", "numba training"),
        lambda _: torch.are_deterministic_algorithms_enabled(),
    ),
)  # fmt: skip

RECORDINGS: tuple[Rule[Call], ...] = (
    Rule("devices other than a CUDA GPU", (), lambda call: call.device != "cuda"),
    Rule("the runtimes openvino and windows", (), lambda call: not call.emulator.runtime.recordable),
    Rule("trainings (`--model.record true` records whole steps)", (), lambda call: call.emulator.training),
    Rule("bounds: error", (), lambda call: call.emulator.constraints.bounds == "error"),
    Rule("gradients", (), lambda call: _need_gradients(call.inputs)),
    Rule("autocast", (), lambda call: _is_autocast(call.device)),
    Rule("graphs that torch.compile traces", (), lambda _: torch.compiler.is_compiling()),
    Rule("nmpm.transfer.without_kernels and scatter_backend", (), lambda _: not is_default()),
    Rule(
        "a recording of something else",
        (),
        lambda _: _is_recording(),
    ),
)
"""What calls that are recorded as CUDA graphs cannot have, whichever engine computes them."""


def is_recordable(call: Call) -> bool:
    """Whether a call can be recorded as a CUDA graph."""
    return not any(rule.holds(call) for rule in RECORDINGS)


def model_engines(recipe: EmulatorRecipe) -> tuple[str, ...]:
    """Those of `FASTER` that compute all that a model has."""
    return tuple(name for name in FASTER if not lacks(name, MODELS, recipe))


def lacks(engine: str, rules: Iterable[Rule[T]], subject: T) -> list[str]:
    """The features of a model or a call that an engine does not compute."""
    return [rule.feature for rule in rules if engine not in rule.engines and rule.holds(subject)]


def call_engine(emulator: Emulator, particles: Particles, solid: Tensor) -> str:
    """The name of the engine that computes a call."""
    fitting, call = emulator.engines, Call(emulator, particles, solid)
    for rule in CALLS:
        if not fitting:
            return "torch"
        if any(name not in rule.engines for name in fitting) and rule.holds(call):
            fitting = tuple(name for name in fitting if name in rule.engines)
    return fitting[0] if fitting else "torch"
