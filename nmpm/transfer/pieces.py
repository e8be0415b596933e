"""Many particles a piece at a time: what an operation needs on the way is then as large as a piece, and time linear."""

from __future__ import annotations

import torch

_MOST = {"cpu": 2**18}
_MOST_ELSEWHERE = 2**22
"""On a GPU many small pieces would cost more in launches than they save."""


def pieces(count: int, device: torch.device) -> list[slice]:
    """Slices that cover so many particles, at least one; graphs that are being traced are left whole."""
    if torch.compiler.is_compiling():
        return [slice(None)]
    most = _MOST.get(device.type, _MOST_ELSEWHERE)
    return [slice(first, first + most) for first in range(0, max(count, 1), most)]
