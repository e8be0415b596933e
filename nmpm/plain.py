"""Between tuples, which recipes hold, and lists, which YAML and JSON hold."""

from __future__ import annotations

from typing import Any


def listed(value: Any) -> Any:
    """The value with tuples as lists, all the way down."""
    return [listed(item) for item in value] if isinstance(value, tuple | list) else value


def tupled(value: Any) -> Any:
    """The value with lists as tuples, all the way down."""
    return tuple(tupled(item) for item in value) if isinstance(value, tuple | list) else value
