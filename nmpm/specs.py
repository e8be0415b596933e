"""Recipes as plain data, so that checkpoints and zoo entries can rebuild what they hold without unpickling anything.

A spec is `{"class_path": ..., "init_args": {...}}`, as in the configuration files. Reading one never imports a module
that the file names: a class is known if `nmpm` ships it, if an installed package offers it as a plugin (see
`nmpm.plugins`), or if the program has already imported it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from nmpm.errors import ConfigError
from nmpm.plain import listed, tupled
from nmpm.plugins import load_plugins

T = TypeVar("T")


def to_spec(recipe: object) -> dict[str, Any]:
    """A frozen dataclass of plain values as its class path and arguments.

    Raises:
        ConfigError: if the object is not a dataclass, whose arguments can be read back.
    """
    if not dataclasses.is_dataclass(recipe):
        raise ConfigError(f"{type(recipe).__name__} must be a dataclass, so that a checkpoint can store its arguments.")
    arguments = {field.name: listed(getattr(recipe, field.name)) for field in dataclasses.fields(recipe)}
    return {"class_path": _path(type(recipe)), "init_args": arguments}


def from_spec(spec: object, base: type[T]) -> T:
    """The recipe that a spec describes; a recipe itself is passed through.

    Args:
        spec: An instance of `base`, or its spec.
        base: What the class must be a subclass of.

    Raises:
        ConfigError: if the class is unknown or does not take the arguments.
    """
    if isinstance(spec, base):
        return spec
    if not isinstance(spec, Mapping) or "class_path" not in spec:
        raise ConfigError(f"Expected a {base.__name__} or its class_path and init_args; got {spec!r}.")
    name = str(spec["class_path"])
    known = {_path(kind): kind for kind in _subclasses(base)}
    if name not in known:
        load_plugins()
        known = {_path(kind): kind for kind in _subclasses(base)}
    if name not in known:
        raise ConfigError(
            f"{base.__name__} {name!r} is not known. Known are {', '.join(sorted(known))}. If it is yours, import its "
            "module first: nothing that a file names is imported by itself."
        )
    arguments = {key: tupled(value) for key, value in dict(spec.get("init_args") or {}).items()}
    try:
        return known[name](**arguments)
    except TypeError as error:
        raise ConfigError(f"{name} cannot be made from {arguments}: {error}.") from error


def _subclasses(base: type[T]) -> Iterator[type[T]]:
    for kind in base.__subclasses__():
        yield kind
        yield from _subclasses(kind)


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
