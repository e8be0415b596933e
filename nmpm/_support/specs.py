"""Recipes as plain data, from which checkpoints and zoo entries are rebuilt without unpickling.

A spec is `{"class_path": ..., "init_args": {...}}`, as in the configuration files. The class path is the public one
(`nmpm.processors.UNet`), which stays when modules move. Reading a spec never imports a module that the file names: a
class is known if `nmpm` ships it, if an installed package offers it as a plugin (see `nmpm._support.plugins`), or if
the program has already imported it.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

from nmpm._support.messages import one_line, suggestion
from nmpm._support.plain_data import from_plain, to_lists
from nmpm._support.plugins import load_plugins
from nmpm.errors import ConfigError

T = TypeVar("T")

RENAMED: Mapping[str, str] = MappingProxyType(
    {
        "nmpm.processors.axial.Axial": "nmpm.processors.Axial",
        "nmpm.processors.convnext.ConvNeXt": "nmpm.processors.ConvNeXt",
        "nmpm.processors.ffno.FFNO": "nmpm.processors.FFNO",
        "nmpm.processors.fno.FNO": "nmpm.processors.FNO",
        "nmpm.processors.fno.TFNO": "nmpm.processors.TFNO",
        "nmpm.processors.identity.Identity": "nmpm.processors.Identity",
        "nmpm.processors.pointwise.Pointwise": "nmpm.processors.Pointwise",
        "nmpm.processors.unet.UNet": "nmpm.processors.UNet",
        "nmpm.processors.unet_modern.UNetModern": "nmpm.processors.UNetModern",
        "nmpm.transfer.affine.Affine": "nmpm.transfer.Affine",
        "nmpm.transfer.linear.Linear": "nmpm.transfer.Linear",
        "nmpm.transfer.nearest.Nearest": "nmpm.transfer.Nearest",
        "nmpm.transfer.quadratic.Quadratic": "nmpm.transfer.Quadratic",
    }
)
"""Class paths in files of version 0.1.0, and their public paths."""


def to_spec(recipe: object) -> dict[str, Any]:
    """The class path and arguments of a frozen dataclass of plain values and other such dataclasses.

    Raises:
        ConfigError: if the object is not a dataclass.
    """
    if not dataclasses.is_dataclass(recipe):
        raise ConfigError(f"{type(recipe).__name__} must be a dataclass, so that a checkpoint can store its arguments.")
    arguments = {field.name: _to_plain(getattr(recipe, field.name)) for field in dataclasses.fields(recipe)}
    return {"class_path": class_path(type(recipe)), "init_args": arguments}


def _to_plain(value: object) -> object:
    """A recipe within another as its spec, other values as plain data."""
    return to_spec(value) if dataclasses.is_dataclass(value) else to_lists(value)


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


def _find_class(name: str, base: type[T]) -> type[T]:
    name = RENAMED.get(name, name)
    for prepare in (lambda: None, load_plugins):
        prepare()
        known = dict(_known_classes(base))
        if name in known:
            return known[name]
    public = sorted({class_path(kind) for kind in known.values()})
    raise ConfigError(
        f"{base.__name__} {one_line(repr(name), 100)} is not known.{suggestion(name[:100], public)} Known are"
        f" {', '.join(public)}. If it is yours, import its module first: modules that a file names are never imported."
    )


def _known_classes(base: type[T]) -> Iterator[tuple[str, type[T]]]:
    """Every subclass with its public path, then with its module's path."""
    for kind in base.__subclasses__():
        yield class_path(kind), kind
        yield f"{kind.__module__}.{kind.__qualname__}", kind
        yield from _known_classes(kind)
