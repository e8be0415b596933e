"""How kernels are launched: over blocks of particles or nodes, and what they are told of a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

BLOCK = 256
"""Particles, or nodes, of a program."""

ONE_PROGRAM = 4096
"""Particles of a scene, or nodes of its grid, up to which one program takes all of them, and one launch all frames."""


def blocks(count: int) -> int:
    """Programs for so many particles or nodes."""
    return max(1, -(-count // BLOCK))


def programs(cells: Tensor) -> tuple[int, int]:
    """Programs of a launch over particles (B, N, D): blocks of each scene."""
    return blocks(cells.shape[1]), len(cells)


def power(count: int) -> int:
    """The least power of two that is not below."""
    return 1 << max(0, count - 1).bit_length()


def whole(count: int) -> int:
    """The block of a program that takes so many particles or nodes, all there are."""
    return max(power(count), 32)


def warps(block: int) -> int:
    """Groups of 32 threads for a program over so many particles or nodes: up to 4 of them a thread, 8 where it must."""
    return min(max(block // 128, 4), 16)


def axes(shape: Sequence[int], wraps: Sequence[bool]) -> dict[str, int]:
    """What kernels are told of a grid in 2-D."""
    (nx, ny), (wx, wy) = shape, wraps
    return {"nx": nx, "ny": ny, "WX": int(wx), "WY": int(wy)}


def walls(confined: Sequence[bool]) -> dict[str, bool]:
    """What kernels are told of the axes that walls confine."""
    return {"WALLS_X": confined[0], "WALLS_Y": confined[1]}


def decoding(decoder: Sequence[Any]) -> dict[str, Any]:
    """What kernels are told of a decoder, see `KernelParameters`."""
    own, of_grid, fall, keeps = map(float, decoder)
    return {"OWN": own, "GRID": of_grid, "FALL": fall, "KEEPS": keeps > 0}
