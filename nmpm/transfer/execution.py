"""How transfers are computed: by kernels or tensor operations, in chunks, and with which sum over particles.

A scatter-add backend is the one operation of p2g whose fastest form depends on the hardware, a function

    add(source (B, L, C), index (B, L), size) -> (B, size, C).

All give the same sums to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType

import torch
from torch import Tensor

from nmpm.errors import ConfigError

Add = Callable[[Tensor, Tensor, int], Tensor]

_CHUNK = 2**18  # particles on a CPU
_CHUNK_ELSEWHERE = 2**22  # on a GPU many small chunks would cost more in kernel launches than they save


def chunks(count: int, device: torch.device, values: int = 1) -> list[slice]:
    """Slices, at least one, that cover `count` particles on a device and bound temporary memory; one in traced graphs.

    Chunks shrink in proportion to the intermediate values that the operation needs for each particle.
    """
    if torch.compiler.is_compiling():
        return [slice(None)]
    size = max(1, (_CHUNK if device.type == "cpu" else _CHUNK_ELSEWHERE) // values)
    return [slice(first, first + size) for first in range(0, max(count, 1), size)]


def is_eager_cpu(values: Tensor) -> bool:
    """Whether code may branch on tensor values: on a CPU, not in traced graphs; elsewhere it would halt the device."""
    return values.device.type == "cpu" and not torch.compiler.is_compiling()


def native(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Torch's own `scatter_add`: bit-reproducible on a CPU for any number of threads, not on a GPU."""
    batch, _, channels = source.shape
    everywhere = index.unsqueeze(-1).expand(-1, -1, channels)
    return source.new_zeros(batch, size, channels).scatter_add(1, everywhere, source)


def in_order(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Sort by place, then sum each place's values in order: slower, and bit-reproducible on every device."""
    batch, length, channels = source.shape
    flat = (index + size * torch.arange(batch, device=index.device).unsqueeze(1)).flatten()
    if not len(flat):
        return source.new_zeros(batch, size, channels)
    places, order = torch.sort(flat, stable=True)
    values = source.reshape(batch * length, channels)[order]
    # Neither `bincount` nor checked lengths: on a GPU both read values back.
    lengths = torch.searchsorted(places, torch.arange(batch * size + 1, device=index.device)).diff()
    summed = torch.segment_reduce(values, "sum", lengths=lengths, axis=0, unsafe=True, initial=0.0)
    return summed.reshape(batch, size, channels)


def by_torch_scatter(source: Tensor, index: Tensor, size: int) -> Tensor:
    """The sum of the package torch-scatter; raises ConfigError if it is not installed, or made for another torch."""
    try:
        import torch_scatter
    except (ImportError, OSError) as error:
        raise ConfigError(
            "The backend torch-scatter needs the package, compiled for this torch: pip install setuptools hatchling "
            f'editables && pip install --no-build-isolation -e ".[scatter]" ({error}).'
        ) from error
    summed: Tensor = torch_scatter.scatter(source, index, dim=1, dim_size=size, reduce="sum")
    return summed


BACKENDS: Mapping[str, Add] = MappingProxyType(
    {"native": native, "sorted": in_order, "torch-scatter": by_torch_scatter}
)

_backend: ContextVar[Add | None] = ContextVar("nmpm_scatter_backend", default=None)
_kernels: ContextVar[bool] = ContextVar("nmpm_kernels", default=True)


@contextmanager
def scatter_backend(name: str) -> Iterator[None]:
    """Choose the scatter-add backend of tensor operations within a `with` block; raises ConfigError for unknown names.

    Outside, it is "sorted" if torch is to be deterministic and the device's own sum is not, else "native".
    """
    if name not in BACKENDS:
        raise ConfigError(f"No transfer backend is called {name!r}; there are {', '.join(BACKENDS)}.")
    token = _backend.set(BACKENDS[name])
    try:
        yield
    finally:
        _backend.reset(token)


@contextmanager
def without_kernels() -> Iterator[None]:
    """Compute with tensor operations alone within a `with` block, without kernels."""
    token = _kernels.set(False)
    try:
        yield
    finally:
        _kernels.reset(token)


def is_default() -> bool:
    """Whether code runs outside of `scatter_backend` and `without_kernels`."""
    return kernels_are_on() and _backend.get() is None


def kernels_are_on() -> bool:
    """Whether code runs outside of `without_kernels`."""
    return _kernels.get()


def add(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Sum values (B, L, C) into places (B, L) from 0 to size - 1, (B, size, C)."""
    fallback = in_order if source.is_cuda and torch.are_deterministic_algorithms_enabled() else native
    return (_backend.get() or fallback)(source, index, size)
