"""Conversion between tuples, which recipes hold, and lists, which YAML and JSON hold."""

from __future__ import annotations

from typing import Any


def to_lists(value: Any) -> Any:
    """The value with tuples as lists, nested ones too."""
    return [to_lists(item) for item in value] if isinstance(value, tuple | list) else value


def to_tuples(value: Any) -> Any:
    """The value with lists as tuples, nested ones too."""
    return tuple(to_tuples(item) for item in value) if isinstance(value, tuple | list) else value
