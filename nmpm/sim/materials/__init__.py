"""Constitutive models, one file each; a new one is its file and its line in `MATERIALS`."""

from nmpm.sim.materials.base import Material
from nmpm.sim.materials.goop import Goop
from nmpm.sim.materials.sand import Sand
from nmpm.sim.materials.water import Water

MATERIALS: dict[str, type[Material]] = {kind.name: kind for kind in (Water, Sand, Goop)}

__all__ = ["MATERIALS", "Goop", "Material", "Sand", "Water"]
