"""Constitutive models, one file each; add a new one to `MATERIALS`."""

from collections.abc import Mapping
from typing import Any

from nmpm._support.plain_data import from_plain
from nmpm.errors import ConfigError
from nmpm.sim.mpm.materials.base import Material
from nmpm.sim.mpm.materials.goop import Goop
from nmpm.sim.mpm.materials.sand import Sand
from nmpm.sim.mpm.materials.water import Water

MATERIALS: dict[str, type[Material]] = {kind.name: kind for kind in (Water, Sand, Goop)}

__all__ = ["MATERIALS", "Goop", "Material", "Sand", "Water", "materials_from_section"]


def materials_from_section(section: Any) -> tuple[Material, ...]:
    """The materials of a preset's section, which maps their names to parameters.

    Raises:
        ConfigError: if a material or a parameter is unknown, or a value is wrong.
    """
    if not isinstance(section, Mapping):
        raise ConfigError("materials must map names to parameters.")
    unknown = sorted(set(section) - set(MATERIALS))
    if unknown:
        raise ConfigError(f"Unknown material {', '.join(map(str, unknown))}; known are {', '.join(MATERIALS)}.")
    return tuple(from_plain(MATERIALS[name], parameters, f"materials.{name}") for name, parameters in section.items())
