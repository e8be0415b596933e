"""Processors, transfers and decoders of other packages.

A package offers its own by an entry point that names the module they are in:

    [project.entry-points."nmpm.plugins"]
    mine = "my_package.my_processor"

Once it is installed, configurations and checkpoints may name its classes. What is imported is what was installed here;
nothing that a file names ever is.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from nmpm.errors import ConfigError

GROUP = "nmpm.plugins"


@cache
def load_plugins() -> tuple[str, ...]:
    """Imports the modules that installed packages offer, once; gives their names.

    Raises:
        ConfigError: if one cannot be imported; names it and its package.
    """
    names = []
    for entry in entry_points(group=GROUP):
        try:
            entry.load()
        except Exception as error:
            package = entry.dist.name if entry.dist is not None else "an unknown package"
            raise ConfigError(f"The plugin {entry.value} of {package} cannot be imported: {error}.") from error
        names.append(entry.value)
    return tuple(names)
