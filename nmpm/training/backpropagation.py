"""Gradients of a training step: discounted from bundle to bundle, and computed in parts of the batch by threads.

The flow of a splash parts neighbours exponentially, and so do gradients grow that go back through it: what a later
bundle says of an earlier one is mostly noise. Discounted, it counts less, and later
bundles still train the weights by their own errors in full.

Threads inside of operations as small as those of a 2-D grid gain nothing; threads that compute scenes of their own do.
The parts do not depend on how many threads work on them, and their gradients are added in order, so that neither do
results.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.modules.conv import _ConvNd

from nmpm._support.threads import map_ranges
from nmpm.emulator import Bundle, Emulator, Prescribed, Rollout
from nmpm.emulator.rollouts import Call, unroll_with_gradients
from nmpm.particles import Particles, Window

T = TypeVar("T")

MOST_PARTS = 4
"""Of a batch: with more, threads wait for Python's interpreter lock, which a part holds for about 15 ms."""


def predict_window(
    emulator: Emulator,
    start: Particles,
    window: Window,
    bundles: int,
    call: Call,
    discount: float,
    noise: Tensor | None,
) -> Rollout:
    """The frames of a training step, with gradients discounted from each bundle to the one before.

    `start` may have noise on its positions; the window says which particles enter and leave, and how obstacles move.
    The noise is (B, M, bundles, Z, *S), of M members of each of B windows, which follow each other in `start`.
    """

    def state_after(bundle: Bundle, start: Particles) -> Particles:
        return discount_gradients(bundle.state_after(start), discount)

    drawn = None if noise is None else noise.flatten(0, 1).unbind(1)
    made = unroll_with_gradients(emulator, start, bundles, call, state_after, Prescribed.of(window), drawn)
    return Rollout.join([Rollout(bundle.position, bundle.fields) for bundle in made])


def discount_gradients(particles: Particles, factor: float) -> Particles:
    """The same particles; gradients that come back through them are multiplied by a factor in [0, 1], 0 cuts them."""
    if factor == 1:
        return particles

    def scale(values: Tensor) -> Tensor:
        if factor == 0:
            return values.detach()
        scaled: Tensor = _Scale.apply(values, factor)  # type: ignore[no-untyped-call]  # (torch's stubs)
        return scaled

    moved = particles.with_motion(scale(particles.position), scale(particles.velocity))
    fields = {name: scale(values) for name, values in particles.fields.items()}
    return moved.with_fields(fields) if fields else moved


class _Scale(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        return ctx.factor * slope, None


def split_rows(count: int, parts: int) -> list[slice]:
    """The rows of a batch of `count` scenes in at most so many parts of about equal size."""
    parts = max(1, min(count, parts))
    ends = [count * part // parts for part in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(ends)]


def on_threads(function: Callable[[slice], T], rows: Sequence[slice], threads: int) -> list[T]:
    """The function's results for each part, in order, computed under the caller's gradient and autocast modes.

    It is called from several threads, in each of which torch's operations use one thread.
    """
    inner = torch.get_num_threads()
    gradients, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    autocast, precision = torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")

    def work(part: int, _: int) -> T:
        torch.set_num_threads(1)
        # Casts of weights are not shared: which thread makes one would decide how its gradients are added.
        cast = torch.autocast("cpu", precision, enabled=autocast, cache_enabled=False)
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients), cast:
            return function(rows[part])

    try:
        return map_ranges(work, [(part, part + 1) for part in range(len(rows))], threads)
    finally:
        torch.set_num_threads(inner)


class CastNetworks:
    """Copies of a network, one for each part, with convolutions' weights in the type that autocast computes in.

    Autocast would cast each weight in each bundle, and its gradient back. Parts share no copy: which thread is first
    would decide in which order gradients are added.
    """

    def __init__(self) -> None:
        self._source: nn.Module | None = None
        self._copies: list[nn.Module] = []

    def __deepcopy__(self, memo: dict[int, Any]) -> CastNetworks:
        return CastNetworks()

    def prepare(self, emulator: Emulator, count: int) -> Callable[[int], Emulator]:
        """A function that gives each of `count` parts its emulator, with the weights of now."""
        network, precision = emulator.processor, torch.get_autocast_dtype("cpu")
        if not torch.is_autocast_enabled("cpu"):
            return lambda _: emulator
        if self._source is not network or len(self._copies) != count:
            self._source, self._copies = network, [_cast(network, precision) for _ in range(count)]
        return lambda part: _with_network(emulator, self._copies[part])


def _cast(network: nn.Module, precision: torch.dtype) -> nn.Module:
    """A copy with the weights of convolutions and linear layers in a precision."""
    cast = copy.deepcopy(network)
    for layer in cast.modules():
        if isinstance(layer, (_ConvNd, nn.Linear)):
            layer.to(precision)
    return cast


def _with_network(emulator: Emulator, network: nn.Module) -> Emulator:
    """The emulator with a copy of its network, which gets its weights."""
    weights: list[Tensor] = list(emulator.processor.parameters())
    copies: list[Tensor] = list(network.parameters())
    with torch.no_grad():
        torch._foreach_copy_(copies, weights)
    for cast, weight in zip(copies, weights, strict=True):
        cast.requires_grad_(weight.requires_grad)
    other = copy.copy(emulator)
    other._modules = {**emulator._modules, "processor": network}
    return other


def mean_over_parts(
    error: Callable[[Emulator, slice], Tensor],
    mask: Tensor,
    rows: Sequence[slice],
    emulator: Emulator,
    networks: CastNetworks,
    threads: int,
) -> Tensor:
    """The mean error () over the particles of all parts, with gradients to the emulator's weights.

    `error` is the mean over the particles of a part; `mask`, (B, N) or (B, T, N), says which particles count.
    """
    if len(rows) == 1:
        return error(emulator, rows[0])
    shares = [mask[part].sum() / mask.sum().clamp(min=1) for part in rows]
    trained = [weight for weight in emulator.parameters() if weight.requires_grad]
    find = networks.prepare(emulator, len(rows))
    mean: Tensor = _MeanOverParts.apply(error, shares, rows, find, threads, *trained)  # type: ignore[no-untyped-call]  # (torch's stubs)
    return mean


class _MeanOverParts(torch.autograd.Function):
    """Computes the gradients together with the error, in one go for each part."""

    @staticmethod
    def forward(
        ctx: Any,
        error: Callable[[Emulator, slice], Tensor],
        shares: Sequence[Tensor],
        rows: Sequence[slice],
        find: Callable[[int], Emulator],
        threads: int,
        *weights: Tensor,
    ) -> Tensor:
        def compute(part: slice) -> tuple[Tensor, Sequence[Tensor | None]]:
            number = rows.index(part)
            emulator = find(number)
            trained = [weight for weight in emulator.parameters() if weight.requires_grad]
            with torch.enable_grad():
                mean = error(emulator, part) * shares[number]
            return mean.detach(), torch.autograd.grad(mean, trained, allow_unused=True)

        means, gradients = zip(*on_threads(compute, rows, threads), strict=True)
        ctx.gradients = [
            _add(weight, parts) for weight, parts in zip(weights, zip(*gradients, strict=True), strict=True)
        ]
        return torch.stack(means).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        return *(None,) * 5, *(None if gradient is None else slope * gradient for gradient in ctx.gradients)


def _add(weight: Tensor, gradients: Sequence[Tensor | None]) -> Tensor | None:
    """The sum, in order, of those that there are, in the memory order of their weight."""
    given = [gradient for gradient in gradients if gradient is not None]
    if not given:
        return None
    total = torch.zeros_like(weight)
    for gradient in given:
        total += gradient
    return total
