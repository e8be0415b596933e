"""Constitutive models, one file each; a new one is its file and its line in `MATERIALS`."""

from nmpm.sim.materials.base import Material
from nmpm.sim.materials.goop import Goop

MATERIALS: dict[str, type[Material]] = {"goop": Goop}

__all__ = ["MATERIALS", "Goop", "Material"]
