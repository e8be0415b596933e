"""Plain data, as YAML and JSON hold them: lists for tuples, mappings for dataclasses."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import Any, Literal, TypeGuard, TypeVar, Union, get_args, get_origin, get_type_hints

from nmpm._support.messages import one_line
from nmpm._support.numbers import is_finite
from nmpm.errors import ConfigError

T = TypeVar("T")

_WORDS = {float: "a finite number", int: "a whole number", str: "text", bool: "true or false", NoneType: "null"}


def to_lists(value: Any) -> Any:
    """The value with tuples as lists, nested ones too."""
    return [to_lists(item) for item in value] if isinstance(value, tuple | list) else value


def to_tuples(value: Any) -> Any:
    """The value with lists as tuples, nested ones too."""
    return tuple(to_tuples(item) for item in value) if isinstance(value, tuple | list) else value


def from_plain(kind: type[T], plain: Any, where: str) -> T:
    """The dataclass that a mapping describes: its keys are the fields, lists are tuples, mappings are dataclasses.

    Values are checked against the annotations of numbers, texts, truth values, and of tuples and dataclasses of them.

    Args:
        kind: The dataclass; fields with defaults may be missing.
        plain: The mapping.
        where: What it is, for errors.

    Raises:
        ConfigError: naming the keys that are unknown, missing, or of the wrong kind.
    """
    if not isinstance(plain, Mapping):
        raise ConfigError(f"{where} must map keys to values; it is {one_line(repr(plain), 80)}.")
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]  # (a dataclass)
    required = {name for name, field in fields.items() if _is_required(field)}
    for problem, keys in (("unknown", set(plain) - set(fields)), ("missing", required - set(plain))):
        if keys:
            listed = one_line(", ".join(sorted(map(str, keys))), 100)
            raise ConfigError(f"{where}: {problem} {listed}; keys: {', '.join(sorted(fields))}.")
    kinds = _annotations(kind)
    entries = {key: _read(value, kinds.get(key, Any), key, where) for key, value in plain.items()}
    try:
        return kind(**entries)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise ConfigError(f"{where}: {one_line(error, 400)}") from error


def _read(plain: Any, kind: Any, key: str, where: str) -> Any:
    """A field's value, of the annotated kind."""
    value, kinds, place = to_tuples(plain), _options(kind), f"{where}, {key}"
    if isinstance(value, Mapping) and (inner := next(filter(_is_section, kinds), None)):
        return from_plain(inner, value, place)
    if isinstance(value, tuple) and get_origin(kind) is tuple and _is_section(inner := get_args(kind)[0]):
        return tuple(from_plain(inner, item, place) for item in value)
    if not _fits(value, kind):
        raise ConfigError(f"{where}: {key} = {one_line(repr(plain), 80)} should be {_describe(kind)}.")
    return value


def _annotations(kind: type) -> Mapping[str, Any]:
    try:
        return get_type_hints(kind)
    except NameError:  # those of a plugin may be importable for type checkers only
        return {}


def _options(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _is_section(kind: Any) -> TypeGuard[type]:
    """Whether a kind is a dataclass of its own, and no base class of several."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind) and not inspect.isabstract(kind)


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated kind; kinds that are none of plain data take all."""
    options, origin, inner = _options(kind), get_origin(kind), get_args(kind)
    if len(options) > 1:
        return any(_fits(value, option) for option in options)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        kinds = inner[:1] * len(value) if isinstance(value, tuple) and inner[-1] is ... else inner
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(_fits, value, kinds))
    if kind is float:
        return is_finite(value)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    checked = kind in _WORDS or _is_section(kind)
    return isinstance(value, kind) if checked else origin is not Mapping or isinstance(value, Mapping)


def _describe(kind: Any) -> str:
    options, origin, inner = _options(kind), get_origin(kind), get_args(kind)
    if len(options) > 1:
        return " or ".join(map(_describe, options))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin is tuple:
        return f"a list, each {_describe(inner[0])}" if inner[-1] is ... else f"[{', '.join(map(_describe, inner))}]"
    return _WORDS.get(kind, "keys and values")


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
