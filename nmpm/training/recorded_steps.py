"""Training steps as CUDA graphs: the error of a batch and its gradients, recorded for each shape and replayed.

On a GPU a step of small scenes is thousands of kernels of a few microseconds, launched one by one from Python; a graph
launches them at once. What varies from step to step is copied to where the graph reads it: the windows, the start's
positions with their noise, and the place of the grid. Weights are read where they are. Gradient clipping and the
optimizer stay outside.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nmpm._support.machine import copy_to
from nmpm.emulator import Emulator
from nmpm.emulator.engines import graphs
from nmpm.emulator.engines.engine import is_autocast
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles, Window

Error = Callable[[Emulator, Particles, Window], Tensor]
"""The mean error () of an emulator's predictions, from the particles that windows start with, with gradients."""

MULTIPLE = 512
"""Numbers of particles are multiples of it in recorded steps, so that few graphs serve all batches."""
_MOST = 16
"""Graphs that are kept: each holds memory. Steps of further shapes are computed operation by operation."""


class RecordedSteps:
    """The errors of training steps with their gradients, by a graph for each shape of batch.

    Where recording fails, this is said once, and steps are computed operation by operation from then on.
    """

    def __init__(self) -> None:
        self._steps: dict[Hashable, _RecordedStep] = {}
        self._pool: Any = None  # of memory that all graphs share
        self._failed = False

    def __reduce__(self) -> tuple[type[RecordedSteps], tuple[()]]:
        return type(self), ()  # copies record graphs of their own

    def mean_error(
        self, error: Error, emulator: Emulator, moved: Emulator, start: Particles, window: Window, settings: Hashable
    ) -> Tensor:
        """`error(moved, start, window)`, with gradients to the weights of `emulator`.

        The error is recorded: it depends on nothing that changes but its arguments and `settings`. `moved` is the
        emulator, or its copy from `with_grid_moved`.
        """
        inputs = None if self._failed else _inputs(emulator, moved, start, window)
        step = inputs and self._find(error, emulator, window, inputs, settings)
        return step(inputs) if inputs and step else error(moved, start, window)

    def _find(
        self, error: Error, emulator: Emulator, window: Window, inputs: Sequence[Tensor], settings: Hashable
    ) -> _RecordedStep | None:
        """The recorded step for inputs of these shapes; None where there is none and none can be recorded."""
        precision = torch.get_autocast_dtype(emulator.device.type) if is_autocast(emulator.device.type) else None
        shapes = tuple((values.shape, values.dtype) for values in inputs)
        key = settings, precision, _addresses(emulator), shapes
        if key not in self._steps and len(self._steps) < _MOST:
            try:
                if self._pool is None and torch.cuda.is_available():
                    self._pool = torch.cuda.graph_pool_handle()
                self._steps[key] = _RecordedStep(error, emulator, window, inputs, self._pool)
            except Exception as failure:  # (of whatever an operation raises that cannot be recorded)
                graphs.warn_not_recorded("Training steps", failure)
                self._failed = True
                self._steps.clear()
        return self._steps.get(key)


def can_record(device: torch.device) -> bool:
    """Whether steps on a device can be recorded."""
    return device.type == "cuda"


class _RecordedStep:
    """The recording of an error and its gradients, for copies of inputs."""

    def __init__(self, error: Error, emulator: Emulator, window: Window, inputs: Sequence[Tensor], pool: Any) -> None:
        if is_autocast(emulator.device.type) and torch.get_autocast_dtype(emulator.device.type) == torch.float16:
            raise ConfigError("in float16 gradients need a scale that changes; use --trainer.precision bf16-mixed.")
        self._inputs = [values.clone(memory_format=torch.contiguous_format) for values in inputs]
        self._weights = [weight for weight in emulator.parameters() if weight.requires_grad]
        batch, start, placed = _arguments(emulator, window, self._inputs)

        device = emulator.device

        def compute() -> tuple[Tensor, Sequence[Tensor | None]]:
            with _fresh_casts(), torch.enable_grad():
                mean = error(placed, start(), batch)
                with torch.autocast(device.type, enabled=False):
                    return mean.detach(), torch.autograd.grad(mean, self._weights, allow_unused=True)

        with torch.random.fork_rng([device] if device.type == "cuda" else []):  # a first replay draws what others do
            self._replay, (self._mean, self._gradients) = graphs.record(compute, device, pool)

    def __call__(self, inputs: Sequence[Tensor]) -> Tensor:
        torch._foreach_copy_(self._inputs, list(inputs))
        self._replay()
        mean: Tensor = _WithGradients.apply(self._mean, self._gradients, *self._weights)  # type: ignore[no-untyped-call]  # (torch's stubs)
        return mean


class _WithGradients(torch.autograd.Function):
    """A value whose gradients with respect to weights are computed already, in memory that is used again."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradients: Sequence[Tensor | None], *weights: Tensor) -> Tensor:  # noqa: ARG004
        ctx.gradients = gradients
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        scaled = iter(torch._foreach_mul([gradient for gradient in ctx.gradients if gradient is not None], slope))
        return None, None, *(None if gradient is None else next(scaled) for gradient in ctx.gradients)


@dataclass(frozen=True)
class _PlacedGrid(Grid):
    """A grid that is moved by `shift` (D,) in domain length, which is read on the device."""

    shift: Tensor = field(kw_only=True, compare=False)

    def to_cells(self, position: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        return super().to_cells(position - self.shift, dtype)

    def to_length(self, cells: Tensor) -> Tensor:
        return super().to_length(cells) + self.shift


def _inputs(emulator: Emulator, moved: Emulator, start: Particles, window: Window) -> list[Tensor]:
    """The shift of the grid (D,), bounds and walls on it, the start's positions, and the windows' tensors."""
    shift = [there - here for there, here in zip(moved.grid.lower, emulator.grid.lower, strict=True)]
    place = copy_to(torch.tensor(shift, dtype=torch.float32, device="cpu"), emulator.device)
    return [place, moved.bounds, moved.walls, start.position, *_tensors(window)]


def _arguments(
    emulator: Emulator, window: Window, inputs: Sequence[Tensor]
) -> tuple[Window, Callable[[], Particles], Emulator]:
    """Windows, their start and an emulator that are made of inputs."""
    shift, bounds, walls, position, *tensors = inputs
    values: Iterator[Tensor] = iter(tensors)
    batch = window.map(lambda _: next(values))
    placed = copy.copy(emulator)
    placed.grid = _PlacedGrid(**vars(emulator.grid), shift=shift)
    placed._buffers = {**emulator._buffers, "bounds": bounds, "walls": walls}
    return batch, lambda: batch.initial.with_motion(position, batch.initial.velocity), placed


def _tensors(window: Window) -> list[Tensor]:
    """The tensors of windows, in the order of `map`."""
    tensors: list[Tensor] = []
    window.map(lambda values: tensors.append(values) or values)  # type: ignore[func-returns-value]
    return tensors


def _addresses(emulator: Emulator) -> Hashable:
    """Where the weights are, which of them are trained, and where the statistics are."""
    weights = tuple((weight.data_ptr(), weight.requires_grad) for weight in emulator.parameters())
    return weights, tuple(buffer.data_ptr() for buffer in emulator.buffers()), emulator.training


@contextmanager
def _fresh_casts() -> Iterator[None]:
    """Autocast without casts of weights from before, or for after: a graph must cast them itself."""
    torch.clear_autocast_cache()
    try:
        yield
    finally:
        torch.clear_autocast_cache()
