"""Dataclasses as plain data, as YAML and JSON hold them, and back.

`to_plain` and `from_plain`: lists for tuples, mappings for dataclasses whose class the reader knows.

`to_spec` and `from_spec`: where the data choose the class, such as that of a processor. A spec is
`{"class_path": ..., "init_args": {...}}`, as in the configuration files; checkpoints and zoo entries are rebuilt from
specs without unpickling. The class path is the public one (`nmpm.processors.UNet`), which stays when modules move.

Reading a spec never imports a module that the file names: a class is known if `nmpm` ships it, if the program has
imported it, or if an installed package offers it by an entry point that names its module:

    [project.entry-points."nmpm.plugins"]
    mine = "my_package.my_processor"
"""

from __future__ import annotations

import dataclasses
import inspect
import operator
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import entry_points
from types import NoneType, UnionType
from typing import Any, Literal, TypeGuard, TypeVar, Union, get_args, get_origin, get_type_hints

from nmpm._support.messages import one_line, suggestion
from nmpm.errors import ConfigError

T = TypeVar("T")

_WORDS = {float: "a finite number", int: "a whole number", str: "text", bool: "true or false", NoneType: "null"}


def to_plain(value: Any) -> Any:
    """Dataclasses as mappings and tuples as lists, nested ones too; other values unchanged."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return [to_plain(item) for item in value] if isinstance(value, tuple | list) else value


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
    required = {name for name, field in fields.items() if field.default is field.default_factory is dataclasses.MISSING}
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


def to_spec(recipe: object) -> dict[str, Any]:
    """The class path and arguments of a frozen dataclass of plain values and other such dataclasses.

    Raises:
        ConfigError: if the object is not a dataclass.
    """
    if not dataclasses.is_dataclass(recipe):
        raise ConfigError(f"{type(recipe).__name__} must be a dataclass, so that a checkpoint can store its arguments.")
    values = {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)}
    arguments = {
        name: to_spec(value) if dataclasses.is_dataclass(value) else to_plain(value) for name, value in values.items()
    }
    return {"class_path": class_path(type(recipe)), "init_args": arguments}


def from_spec(spec: object, base: type[T]) -> T:
    """The recipe that a spec describes; a recipe itself is returned unchanged.

    Args:
        spec: An instance of `base`, or its spec.
        base: The base class that the recipe must have.

    Raises:
        ConfigError: if the class is unknown or does not take the arguments, or the spec has other keys.
    """
    if isinstance(spec, base):
        return spec
    if not isinstance(spec, Mapping) or "class_path" not in spec:
        raise ConfigError(
            f"Expected a {base.__name__} or its class_path and init_args; got {one_line(repr(spec), 100)}."
        )
    unknown = sorted(str(key) for key in set(spec) - {"class_path", "init_args"})
    if unknown:
        keys = one_line(", ".join(unknown), 100)
        raise ConfigError(
            f"{base.__name__} {one_line(spec['class_path'], 100)} has the unknown keys {keys} beside class_path and"
            " init_args: move arguments into init_args."
        )
    kind = _find_class(str(spec["class_path"]), base)
    given = {} if spec.get("init_args") is None else spec["init_args"]
    return from_plain(kind, given, class_path(kind))


def class_path(kind: type) -> str:
    """The shortest path under which a class can be imported: of the outermost package that exports it."""
    parts = kind.__module__.split(".")
    for end in range(1, len(parts)):
        package = ".".join(parts[:end])
        # From the module's own namespace, as attributes that packages import lazily would be imported here.
        if vars(sys.modules.get(package, object)).get(kind.__qualname__) is kind:
            return f"{package}.{kind.__qualname__}"
    return f"{kind.__module__}.{kind.__qualname__}"


@cache
def load_plugins() -> tuple[str, ...]:
    """Import the modules that installed packages offer as plugins, once, and return their names.

    Raises:
        ConfigError: if one cannot be imported, naming it and its package.
    """
    names = []
    for entry in entry_points(group="nmpm.plugins"):
        try:
            entry.load()
        except Exception as error:
            package = entry.dist.name if entry.dist is not None else "an unknown package"
            raise ConfigError(
                f"The plugin {entry.value} of {package} cannot be imported: {one_line(error)}."
            ) from error
        names.append(entry.value)
    return tuple(names)


def _find_class(name: str, base: type[T]) -> type[T]:
    classes = {class_path(kind): kind for kind in _subclasses(base)}
    if name not in classes:
        load_plugins()
        classes = {class_path(kind): kind for kind in _subclasses(base)}
    if name in classes:
        return classes[name]
    raise ConfigError(
        f"{base.__name__} {one_line(repr(name), 100)} is not known.{suggestion(name[:100], classes)} Known are"
        f" {', '.join(sorted(classes))}. If it is yours, import its module first: modules that a file names are never"
        " imported."
    )


def _subclasses(base: type[T]) -> Iterator[type[T]]:
    for kind in base.__subclasses__():
        yield kind
        yield from _subclasses(kind)


def _read(plain: Any, kind: Any, key: str, where: str) -> Any:
    """A field's value, of the annotated kind."""
    value = to_tuples(plain)
    if isinstance(value, Mapping) and (section := next(filter(_is_section, _options(kind)), None)):
        return from_plain(section, value, f"{where}, {key}")
    if isinstance(value, tuple) and get_origin(kind) is tuple and _is_section(section := get_args(kind)[0]):
        return tuple(from_plain(section, item, f"{where}, {key}") for item in value)
    if not fits(value, kind):
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


def fits(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated kind; kinds that are none of plain data take all."""
    options, origin, inner = _options(kind), get_origin(kind), get_args(kind)
    if len(options) > 1:
        return any(fits(value, option) for option in options)
    if origin is Literal:
        return (type(value), value) in [(type(choice), choice) for choice in inner]  # 1 == 1.0 == True
    if origin is tuple:
        kinds = inner[:1] * len(value) if isinstance(value, tuple) and inner[-1] is ... else inner
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(fits, value, kinds))
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
