"""Reading dataclasses from the sections of a preset's file, with errors that name the section and key."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from nmpm._support.plain_data import to_lists, to_tuples
from nmpm.errors import ConfigError


def check(condition: bool, message: str) -> None:
    """Raise a ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def section_entries(kind: type[Any], section: Any, where: str) -> dict[str, Any]:
    """A copy of a section whose keys are the fields of a dataclass; fields with defaults may be missing.

    Raises:
        ConfigError: naming the keys that are unknown or missing.
    """
    if not isinstance(section, Mapping):
        raise ConfigError(f"{where} must map keys to values; it is {section!r}.")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    required = {name for name, field in fields.items() if _is_required(field)}
    for problem, keys in (("unknown", set(section) - set(fields)), ("missing", required - set(section))):
        if keys:
            raise ConfigError(
                f"{where}: {problem} {', '.join(sorted(map(str, keys)))}; keys: {', '.join(sorted(fields))}."
            )
    return dict(section)


def from_section(kind: type[Any], section: Any, where: str) -> Any:
    """A dataclass from a section's entries, with lists as tuples.

    Raises:
        ConfigError: if a key is unknown or missing, or a value is wrong.
    """
    entries = {key: to_tuples(value) for key, value in section_entries(kind, section, where).items()}
    try:
        return kind(**entries)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


def to_plain(value: Any) -> Any:
    """Dataclasses as dicts and tuples as lists, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return to_lists(value)


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
