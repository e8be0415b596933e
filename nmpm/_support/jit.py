"""How kernels are compiled by Numba."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Fused multiply-add is allowed; nothing else may change, since the checks for non-finite values rely on NaN.
_FASTMATH = {"contract"}


def jit(function: F) -> F:
    """Compile a function by Numba: cached on disk, single-threaded, without the interpreter's lock."""
    return _compile(function, _FASTMATH)


def jit_sum(function: F) -> F:
    """`jit` for sums whose terms may be added in any order, several at once; NaN stays NaN."""
    return _compile(function, _FASTMATH | {"reassoc"})


def _compile(function: F, fastmath: set[str]) -> F:
    options = {"nogil": True, "error_model": "numpy", "fastmath": fastmath}
    try:
        return cast(F, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        return cast(F, numba.njit(**options)(function))
