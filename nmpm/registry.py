"""Registries: parts by name, the built-in ones first, then those of other installed packages.

A package adds a part by an entry point in its `pyproject.toml`:

    [project.entry-points."nmpm.readers"]
    raw = "my_package.raw:Raw"
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from nmpm._support.messages import one_line, suggestion
from nmpm.errors import ConfigError

Part = TypeVar("Part")


class Registry(Generic[Part]):
    """The parts of a kind by name; each is imported when it is first asked for.

    Args:
        group: Entry-point group of the parts of other packages, such as "nmpm.readers".
        noun: What a part is, for messages.
        built_in: The package's own parts by name, or where they are: "module:attribute".
    """

    def __init__(self, group: str, noun: str, built_in: Mapping[str, str | Part]) -> None:
        self.group, self.noun, self.built_in = group, noun, built_in
        self._loaded: dict[str, Part] = {}

    @cached_property
    def plugins(self) -> Mapping[str, EntryPoint]:
        """The entry points of other packages by name; a name that is built in stays the built-in part."""
        plugins: dict[str, EntryPoint] = {}
        for point in sorted(entry_points(group=self.group), key=_package):
            if point.name in self.built_in or point.name in plugins:
                first = _package(plugins[point.name]) if point.name in plugins else "nmpm"
                warnings.warn(
                    f"The {self.noun} {point.name!r} of the package {_package(point)} is not used: {first} has one of"
                    " that name. Rename its entry point.",
                    stacklevel=3,
                )
            else:
                plugins[point.name] = point
        return plugins

    def __iter__(self) -> Iterator[str]:
        yield from self.built_in
        yield from self.plugins

    def values(self) -> Iterator[Part]:
        """All parts, in the order of their names; raises as for one."""
        return map(self.__getitem__, self)

    def __contains__(self, name: object) -> bool:
        return name in self.built_in or name in self.plugins

    def __getitem__(self, name: str) -> Part:
        """The part of a name.

        Raises:
            ConfigError: if there is none, naming similar ones, or the package that has it cannot be imported.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> Part:
        if name in self.built_in:
            place = self.built_in[name]
            if not isinstance(place, str):
                return place
            module, _, attribute = place.partition(":")
            part: Part = getattr(import_module(module), attribute)
            return part
        if name not in self.plugins:
            raise ConfigError(
                f"There is no {self.noun} {one_line(repr(name), 60)}; there are {', '.join(self)}."
                f"{suggestion(name[:60], self)}"
            )
        point = self.plugins[name]
        try:
            loaded: Part = point.load()
        except Exception as error:  # (another package's import may raise anything)
            raise ConfigError(
                f"The {self.noun} {name!r} of the package {_package(point)} ({point.value}) cannot be imported"
                f" ({type(error).__name__}: {one_line(error)}). Mend or uninstall that package."
            ) from error
        return loaded


def _package(point: EntryPoint) -> str:
    """The name of the package that declares an entry point."""
    distribution: Any = point.dist
    return "" if distribution is None else str(distribution.name)
