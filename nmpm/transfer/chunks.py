"""Chunks of particles, so that temporary memory is bounded and time linear; and when code may read values back."""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK = {"cpu": 2**18}
_CHUNK_ELSEWHERE = 2**22
"""On a GPU many small chunks would cost more in kernel launches than they save."""


def chunks(count: int, device: torch.device, values: int = 1) -> list[slice]:
    """Slices that cover `count` particles, at least one slice; a single one in graphs that are being traced.

    Args:
        count: Number of particles.
        device: Where they are; decides the size of a chunk.
        values: Intermediate values that the operation needs for each particle; chunks shrink in proportion.
    """
    if torch.compiler.is_compiling():
        return [slice(None)]
    size = max(1, _CHUNK.get(device.type, _CHUNK_ELSEWHERE) // values)
    return [slice(first, first + size) for first in range(0, max(count, 1), size)]


def can_branch(values: Tensor) -> bool:
    """Whether code may branch on tensor values: on a CPU, not in traced graphs; elsewhere it would halt the device."""
    return values.device.type == "cpu" and not torch.compiler.is_compiling()
