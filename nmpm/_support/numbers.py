"""Numbers among values from files."""

from __future__ import annotations

import operator
import sys
from typing import Any, TypeGuard

from nmpm._support.messages import one_line
from nmpm.errors import ConfigError


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a number, and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_finite(value: object) -> TypeGuard[int | float]:
    """Whether a value is a number, no truth value, and finite in float64."""
    return is_number(value) and -sys.float_info.max <= value <= sys.float_info.max


def check_whole(name: str, value: Any, least: int) -> int:
    """An argument that must be a whole number of at least `least`; NumPy's are taken too.

    Raises:
        ConfigError: naming the argument and its value.
    """
    try:
        number = least - 1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise ConfigError(f"{name} = {one_line(repr(value), 60)}: it must be a whole number, at least {least}.")
    return number
