"""Constitutive models, one file each; add a new one to `MATERIALS`."""

from nmpm.sim.mpm.materials.base import Material
from nmpm.sim.mpm.materials.goop import Goop
from nmpm.sim.mpm.materials.sand import Sand
from nmpm.sim.mpm.materials.water import Water

MATERIALS: dict[str, type[Material]] = {kind.name: kind for kind in (Water, Sand, Goop)}

__all__ = ["MATERIALS", "Goop", "Material", "Sand", "Water"]
