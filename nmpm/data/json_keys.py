"""Takes the keys of a JSON object one by one; errors name the file, the key and its value.

Parsers raise a TypeError or ValueError that states what is wanted.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from nmpm._support.messages import one_line
from nmpm._support.numbers import is_finite
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Interval, check_field_names

REQUIRED: Any = object()
"""In place of a default: the key must be there."""


class JsonKeys:
    """The keys of a JSON object that are not taken yet.

    Args:
        where: The object's file.
        plain: The object.
        problems: Collects what is wrong; None raises it.
        substitutes: Values, where problems are collected, for keys that are missing or wrong; others take the default.
    """

    def __init__(
        self,
        where: Path | str,
        plain: Mapping[str, Any],
        problems: list[str] | None = None,
        substitutes: Mapping[str, Any] | None = None,
    ) -> None:
        self.where, self.left, self.problems, self.substitutes = where, dict(plain), problems, substitutes or {}

    def peek(self, key: str, parse: Callable[[Any], Any], default: Any = REQUIRED) -> Any:
        """The parsed value of a key; `parse` raises a TypeError or ValueError that states what is wanted."""
        value = self.left.get(key)
        if value is None and default is not REQUIRED:
            return default
        try:
            if value is not None:
                return parse(value)
            problem = f"{self.where}: the key {key!r} is missing."
        except (TypeError, ValueError) as error:
            problem = f"{self.where}: {key} = {one_line(json.dumps(value, default=repr), 80)} should be {error}."
        if self.problems is None:
            raise DataError(problem)
        self.problems.append(problem)
        return self.substitutes.get(key, default)

    def take(self, key: str, parse: Callable[[Any], Any], default: Any = REQUIRED) -> Any:
        """As `peek`, and removes the key from those that are left."""
        value = self.peek(key, parse, default)
        self.left.pop(key, None)
        return value


def parse_dim(value: Any) -> int:
    """1, 2 or 3."""
    if value not in (1, 2, 3) or isinstance(value, bool | float):
        raise ValueError("1, 2 or 3")
    return int(value)


def parse_count(value: Any) -> int:
    """A positive integer."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError("a positive integer")
    return value


def parse_positive(value: Any) -> float:
    """A positive, finite number."""
    if not is_finite(value) or value <= 0:
        raise ValueError("a positive number")
    return float(value)


def parse_densities(value: Any) -> dict[str, float]:
    """Positive numbers by name."""
    if not isinstance(value, Mapping):
        raise TypeError('positive numbers by material, e.g. {"water": 1000}')
    return {str(name): parse_positive(density) for name, density in value.items()}


def parse_field_names(value: Any) -> tuple[str, ...]:
    """Names of fields from a list."""
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ValueError('a list of names of fields, e.g. ["temperature"]')
    try:
        check_field_names(value)
    except ConfigError as error:
        raise ValueError(f"a list of names of fields ({error})") from error
    return tuple(value)


def parse_ids(value: Any) -> frozenset[int]:
    """A set of type ids from a list."""
    if not isinstance(value, list) or not all(isinstance(i, int) and not isinstance(i, bool) for i in value):
        raise ValueError("a list of type ids")
    return frozenset(value)


def parse_names(value: Any) -> dict[int, str]:
    """Names by type id."""
    if not isinstance(value, Mapping) or not value or not all(isinstance(name, str) for name in value.values()):
        raise ValueError('an object that maps ids to names, e.g. {"7": "goop"}')
    if not all(re.fullmatch(r"-?\d{1,18}", i) for i in value):
        raise ValueError('an object whose keys are integers, e.g. {"7": "goop"}')
    return {int(i): name for i, name in value.items()}


def parse_vector(value: Any, dim: int) -> tuple[float, ...]:
    """`dim` finite numbers."""
    if not isinstance(value, list) or len(value) != dim or not all(map(is_finite, value)):
        raise ValueError(f"a list of {dim} finite numbers, one per axis")
    return tuple(map(float, value))


def parse_intervals(value: Any, dim: int) -> tuple[Interval, ...]:
    """(lower, upper) for each of `dim` axes."""
    wanted = f"a list of {dim} pairs [lower, upper] with lower < upper, one per axis"
    if not isinstance(value, list) or len(value) != dim:
        raise ValueError(wanted)
    for pair in value:
        if not isinstance(pair, list) or len(pair) != 2 or not all(map(is_finite, pair)) or pair[0] >= pair[1]:
            raise ValueError(wanted)
    return tuple((float(low), float(high)) for low, high in value)


def parse_flags(value: Any, dim: int) -> tuple[bool, ...]:
    """A truth value for each of `dim` axes; LagrangeBench gives three to two-dimensional scenes as well."""
    if not isinstance(value, list) or len(value) < dim or not all(isinstance(flag, bool) for flag in value):
        raise ValueError(f"a list of at least {dim} booleans, one per axis")
    return tuple(value[:dim])
