"""How the kernels of the simulators are compiled."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

# Products may be fused with sums; nothing else may change, as NaN must keep its meaning for the check that finds it.
_FASTMATH = {"contract"}


def compiled(function: F) -> F:
    """A function compiled by Numba: cached on disk, one thread, free of the interpreter's lock."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FASTMATH)(function))
