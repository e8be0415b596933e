"""The alternate stack of this thread's signal handlers, kept through code that replaces it.

Python's handlers, Ctrl-C's among them, run on the alternate stack if a thread has one. OpenVINO's CPU plugin installs
one of its own when it is loaded, too small for them on processors with wide registers: the next signal ended the
process by a segmentation fault.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager


class _Stack(ctypes.Structure):
    """`stack_t` of Linux."""

    _fields_ = (("pointer", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


@contextmanager
def kept_signal_stack() -> Iterator[None]:
    """Restore this thread's alternate signal stack on leaving. No-op on systems other than Linux."""
    if sys.platform != "linux":
        yield
        return
    library, before = ctypes.CDLL(None), _Stack()
    library.sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        library.sigaltstack(ctypes.byref(before), None)
