"""CUDA graphs: a whole call, network and all around it, recorded once and launched as one.

On a GPU a small scene's call is hundreds of kernels of a few microseconds, each launched from Python; a graph launches
them all at once. Shapes are fixed: each batch and number of particles has a graph of its own.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from nmpm.emulator.engines.rules import RECORDINGS, Call, takes
from nmpm.emulator.runtimes.runtime import MOST, Programs

if TYPE_CHECKING:
    from nmpm.emulator.bundle import Bundle, RolloutContext
    from nmpm.emulator.model import Emulator
    from nmpm.particles import Particles

T = TypeVar("T")

_WARM_UP = 3
"""Calls before a graph is recorded: libraries choose kernels and allocate workspaces in them."""
_COST = 32
"""Calls that take as long as a recording, at most."""
_REMEMBERED = 64
"""Shapes of states that are compared with further ones."""


class RecordedCalls:
    """Replays an emulator's calls on a GPU from a recording for each shape of state, made when the shape comes again.

    Where shapes change with each call, calls are computed operation by operation; so are all after one that cannot be
    recorded, of which a warning says why. Copies and unpickled instances start without recordings.
    """

    def __init__(self) -> None:
        self._recordings: Programs[_Recording] = Programs()
        self._seen: deque[Hashable] = deque(maxlen=_REMEMBERED)
        self._calls = self._made = 0
        self._failed = False

    def __reduce__(self) -> tuple[type[RecordedCalls], tuple[()]]:
        return type(self), ()

    def predict(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> Bundle:
        """The emulator's bundle, recorded if this call can be."""
        if self._failed or not takes(RECORDINGS, Call(emulator, particles, context.solid)):
            return emulator.runtime.bundle(emulator, particles, context)
        inputs = _inputs(particles, context)
        recording = self._find(emulator, particles, context, _key(particles, inputs))
        return emulator.predict(particles, context) if recording is None else recording(inputs)

    def _find(
        self, emulator: Emulator, particles: Particles, context: RolloutContext, key: Hashable
    ) -> _Recording | None:
        """The recording for states of this kind; None where there is none and it would not pay, or fails."""
        self._calls += 1
        recording = self._recordings.get(emulator, key)
        if recording is None and self._pays((id(emulator), key)):
            self._made += 1
            try:
                return self._recordings.find(emulator, key, lambda: _Recording(emulator, particles, context))
            except Exception as failure:  # (of whatever an operation raises that cannot be recorded)
                warn_not_recorded("Calls", failure)
                self._failed = True
        return recording

    def _pays(self, key: Hashable) -> bool:
        """Whether to record: a kind of state that has been seen, and not so often that recording takes all the time."""
        if key not in self._seen:
            self._seen.append(key)
            return False
        return self._made < MOST or self._calls > _COST * self._made


class _Recording:
    """The recording of an emulator's call, for copies of its inputs."""

    def __init__(self, emulator: Emulator, particles: Particles, context: RolloutContext) -> None:
        self._lock = Lock()
        with torch.inference_mode(False), torch.no_grad():  # the copies' values change outside of inference mode, too
            budget = None if context.budget is None else _copy(context.budget)
            noise = None if context.noise is None else _copy(context.noise)
            still = dataclasses.replace(context, solid=_copy(context.solid), budget=budget, noise=noise)
            copies = particles.map(_copy), still
            self._inputs = _inputs(*copies)
            self._replay, self._bundle = record(lambda: emulator.predict(*copies), particles.position.device)

    def __call__(self, inputs: Sequence[Tensor]) -> Bundle:
        """The bundle for inputs of these shapes, in fresh memory."""
        with self._lock, torch.no_grad():
            torch._foreach_copy_(self._inputs, list(inputs))
            self._replay()
            made = self._bundle
            fields = {name: values.clone() for name, values in made.fields.items()}
            return dataclasses.replace(
                made, position=made.position.clone(), velocity=made.velocity.clone(), fields=fields
            )


def _copy(tensor: Tensor) -> Tensor:
    return tensor.clone(memory_format=torch.contiguous_format)


def _inputs(particles: Particles, context: RolloutContext) -> list[Tensor]:
    """All tensors that a call depends on but those of the emulator, in the order of `_key`."""
    given = [values for values in vars(particles).values() if isinstance(values, Tensor)]
    further = [values for values in (context.budget, context.noise) if values is not None]
    return [*given, *particles.fields.values(), context.solid, *further]


def _key(particles: Particles, inputs: Sequence[Tensor]) -> Hashable:
    """What a recording depends on beside the values of its inputs and the emulator."""
    names = tuple(name for name, values in vars(particles).items() if isinstance(values, Tensor))
    shapes = tuple((tensor.shape, tensor.dtype) for tensor in inputs)
    device = particles.position.device
    stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
    return names, tuple(particles.fields), shapes, device, stream, _arithmetic()


def _arithmetic() -> Hashable:
    """Torch's settings that decide which kernels are recorded."""
    places = getattr(torch.backends.cudnn, "conv", torch.backends.cudnn), torch.backends.cuda.matmul
    rounding = tuple(p.fp32_precision if hasattr(p, "fp32_precision") else p.allow_tf32 for p in places)
    return rounding, torch.are_deterministic_algorithms_enabled()


def warn_not_recorded(what: str, failure: Exception) -> None:
    """Warn that something is not recorded, of whatever an operation raises that cannot be."""
    reason = (str(failure).splitlines() or [type(failure).__name__])[0][:200]
    warnings.warn(f"{what} are not recorded as CUDA graphs: {reason}", stacklevel=5)


def record(function: Callable[[], T], device: torch.device, pool: Any = None) -> tuple[Callable[[], None], T]:
    """A launch of the kernels that a function runs on a GPU, and its result, whose tensors each launch overwrites.

    Recordings with the same `pool` of memory overwrite each other's results. Other threads may use the GPU meanwhile.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                function()
        torch.cuda.current_stream().wait_stream(aside)
        try:
            with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
                result = function()
        except Exception:
            _replace_generator(device)
            raise

    def replay() -> None:
        with torch.cuda.device(device):
            graph.replay()

    return replay, result


def _replace_generator(device: torch.device) -> None:
    """Give a GPU a new state of random numbers: that of a recording that failed waits for its end for ever."""
    fresh = torch.Generator(device).graphsafe_get_state()
    torch.cuda.default_generators[device.index or 0].graphsafe_set_state(fresh)
