"""Scatter-add backends, for the one operation of p2g whose fastest form depends on the hardware.

All give the same sums to rounding. Which one runs is decided in each call: the one chosen with `using`, else `sorted`
if torch is to be deterministic and the device's own sum is not, else `native`. A backend is a function

    add(source (B, L, C), index (B, L), size) -> (B, size, C)
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
    """The sum of the package torch-scatter.

    Raises:
        ConfigError: if it is not installed, or made for another torch.
    """
    try:
        import torch_scatter
    except (ImportError, OSError) as error:
        raise ConfigError(
            "The backend torch-scatter needs the package, compiled for this torch: pip install setuptools && pip "
            f"install --no-build-isolation torch-scatter==2.1.2 ({error})."
        ) from error
    summed: Tensor = torch_scatter.scatter(source, index, dim=1, dim_size=size, reduce="sum")
    return summed


BACKENDS: Mapping[str, Add] = MappingProxyType(
    {"native": native, "sorted": in_order, "torch-scatter": by_torch_scatter}
)

_chosen: ContextVar[Add | None] = ContextVar("nmpm_transfer_backend", default=None)


@contextmanager
def using(name: str) -> Iterator[None]:
    """Choose the backend within a `with` block, in which no fused kernel runs (`nmpm.emulator.fused`).

    Args:
        name: "native", "sorted" or "torch-scatter".

    Raises:
        ConfigError: if there is none of that name.
    """
    if name not in BACKENDS:
        raise ConfigError(f"No transfer backend is called {name!r}; there are {', '.join(BACKENDS)}.")
    token = _chosen.set(BACKENDS[name])
    try:
        yield
    finally:
        _chosen.reset(token)


def is_chosen() -> bool:
    """Whether code runs within `using`, and so with tensor operations alone."""
    return _chosen.get() is not None


def kernels_take(*values: Tensor) -> bool:
    """Whether fused kernels can take these tensors: float32 on a CPU, outside of `using`."""
    return not is_chosen() and all(each.device.type == "cpu" and each.dtype == torch.float32 for each in values)


def add(source: Tensor, index: Tensor, size: int) -> Tensor:
    """Sum values into places.

    Args:
        source: (B, L, C) values.
        index: (B, L) int64 place of each, from 0 to size - 1.
        size: Number of places.

    Returns:
        (B, size, C).
    """
    fallback = in_order if source.is_cuda and torch.are_deterministic_algorithms_enabled() else native
    return (_chosen.get() or fallback)(source, index, size)
