"""A check that presets and their sections share."""

from __future__ import annotations

from nmpm.errors import ConfigError


def check(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)
