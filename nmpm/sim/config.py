"""What presets and their sections share: a check, and the way back to plain data."""

from __future__ import annotations

import dataclasses
from typing import Any

from nmpm._support.plain_data import to_lists
from nmpm.errors import ConfigError


def check(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def to_plain(value: Any) -> Any:
    """Dataclasses as dicts and tuples as lists, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return to_lists(value)
