"""Validation of JSON objects key by key, with errors that name the file, the key and its value.

Parsers raise a TypeError or ValueError that states what is wanted.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from nmpm._support.limits import WHOLE
from nmpm._support.messages import one_line
from nmpm.errors import ConfigError, DataError
from nmpm.scene import Interval, check_field_names


class JsonKeys:
    """Validates and removes the keys of a JSON object one by one; errors name the file and the key."""

    _REQUIRED = object()

    def __init__(self, path: Path | str, plain: dict[str, Any]) -> None:
        self.path = path
        self.left = plain

    def error(self, key: str, value: Any, wanted: str) -> DataError:
        return DataError(f"{self.path}: {key} = {one_line(_repr(value), 80)} should be {wanted}.")

    def peek(self, key: str, parse: Callable[[Any], Any], default: Any = _REQUIRED) -> Any:
        if self.left.get(key) is None:
            if default is self._REQUIRED:
                raise DataError(f"{self.path}: the key {key!r} is missing.")
            return default
        try:
            return parse(self.left[key])
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error(key, self.left[key], str(error)) from error

    def take(self, key: str, parse: Callable[[Any], Any], default: Any = _REQUIRED) -> Any:
        value = self.peek(key, parse, default)
        self.left.pop(key, None)
        return value


def _repr(value: Any) -> str:
    try:
        return json.dumps(value)
    except (TypeError, ValueError):
        return type(value).__name__


def parse_number(value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < math.inf:
        raise ValueError("a finite number")
    return float(value)


def parse_positive(value: Any) -> float:
    """A positive, finite number."""
    if parse_number(value) <= 0:
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


def parse_whole(value: Any) -> int:
    """A positive integer."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value < WHOLE:
        raise ValueError(f"a positive integer below {WHOLE}")
    return value


def parse_ids(value: Any) -> frozenset[int]:
    """A set of type ids from a list."""
    if not isinstance(value, list) or any(
        isinstance(i, bool) or not isinstance(i, int) or abs(i) > WHOLE for i in value
    ):
        raise ValueError("a list of type ids")
    return frozenset(value)


def parse_names(value: Any) -> dict[int, str]:
    """Names by type id."""
    if not isinstance(value, Mapping) or not value or not all(isinstance(name, str) for name in value.values()):
        raise ValueError('an object that maps ids to names, e.g. {"7": "goop"}')
    try:
        types = {int(i): name for i, name in value.items()}
    except ValueError as error:
        raise ValueError('an object whose keys are integers, e.g. {"7": "goop"}') from error
    if any(abs(i) > WHOLE for i in types):
        raise ValueError(f"an object whose keys are at most {WHOLE}")
    return types


def vector_parser(dim: int) -> Callable[[Any], tuple[float, ...]]:
    """A parser of `dim` finite numbers."""

    def parse(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != dim:
            raise ValueError(f"a list of {dim} numbers, one per axis")
        return tuple(parse_number(item) for item in value)

    return parse


def intervals_parser(dim: int) -> Callable[[Any], tuple[Interval, ...]]:
    """A parser of (lower, upper) for each of `dim` axes."""
    wanted = f"a list of {dim} pairs [lower, upper] with lower < upper, one per axis"

    def parse(value: Any) -> tuple[Interval, ...]:
        if not isinstance(value, list) or len(value) != dim:
            raise ValueError(wanted)
        pairs = [vector_parser(2)(pair) for pair in value]
        if any(low >= high for low, high in pairs):
            raise ValueError(wanted)
        return tuple((low, high) for low, high in pairs)

    return parse


def flags_parser(dim: int) -> Callable[[Any], tuple[bool, ...]]:
    """A parser of a truth value for each of `dim` axes."""

    def parse(value: Any) -> tuple[bool, ...]:
        # LagrangeBench gives three flags to two-dimensional scenes as well.
        if not isinstance(value, list) or len(value) < dim or not all(isinstance(flag, bool) for flag in value):
            raise ValueError(f"a list of at least {dim} booleans, one per axis")
        return tuple(value[:dim])

    return parse
