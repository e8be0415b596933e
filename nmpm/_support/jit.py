"""How kernels are compiled by Numba."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Fused multiply-add is allowed; nothing else may change, since the checks for non-finite values rely on NaN.
_FASTMATH = {"contract"}


def jit(function: F) -> F:
    """Compile a function by Numba: cached on disk, single-threaded, without the interpreter's lock."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FASTMATH)(function))


def jit_sum(function: F) -> F:
    """`jit` for sums whose terms may be added in any order, several at once; NaN stays NaN."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FASTMATH | {"reassoc"})(function))
