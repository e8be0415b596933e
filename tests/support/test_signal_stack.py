"""The alternate signal stack survives code that replaces it."""

import ctypes
import sys

import pytest

from nmpm._support.signal_stack import _Stack, kept_signal_stack

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no-op elsewhere")


def current() -> tuple[int | None, int, int]:
    stack = _Stack()
    ctypes.CDLL(None).sigaltstack(None, ctypes.byref(stack))
    return stack.pointer, stack.flags, stack.size


def replace_stack(memory) -> None:
    """Install an alternate stack, then fail."""
    other = _Stack(ctypes.addressof(memory), 0, len(memory))
    assert ctypes.CDLL(None).sigaltstack(ctypes.byref(other), None) == 0
    assert current()[0] == ctypes.addressof(memory)
    raise KeyError


def test_a_replaced_stack_is_restored_after_an_error_too():
    before, memory = current(), ctypes.create_string_buffer(2**17)
    with pytest.raises(KeyError), kept_signal_stack():
        replace_stack(memory)
    assert current() == before
