"""Plugins: processors, transfers and decoders of other packages.

A package offers its classes by an entry point that names their module:

    [project.entry-points."nmpm.plugins"]
    mine = "my_package.my_processor"

Once it is installed, configurations and checkpoints may name its classes. Only modules of installed packages are
imported, never one that a file names.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from nmpm._support.messages import one_line
from nmpm.errors import ConfigError

GROUP = "nmpm.plugins"


@cache
def load_plugins() -> tuple[str, ...]:
    """Import the modules that installed packages offer, once, and return their names.

    Raises:
        ConfigError: if one cannot be imported, naming it and its package.
    """
    names = []
    for entry in entry_points(group=GROUP):
        try:
            entry.load()
        except Exception as error:
            package = entry.dist.name if entry.dist is not None else "an unknown package"
            raise ConfigError(
                f"The plugin {entry.value} of {package} cannot be imported: {one_line(error)}."
            ) from error
        names.append(entry.value)
    return tuple(names)
