"""Grid-based emulators of particle simulations, trained with Lightning, with a zoo of pretrained models.

The public names are imported when first used, so that `import nmpm` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nmpm.version import __version__

if TYPE_CHECKING:
    from nmpm.data.convert.arrays import write_trajectories as write_trajectories
    from nmpm.data.format import Trajectory as Trajectory
    from nmpm.emulator import Emulator as Emulator
    from nmpm.particles import Particles as Particles
    from nmpm.rollouts import rollout as rollout
    from nmpm.scene import Scene as Scene
    from nmpm.zoo import Zoo as Zoo

__all__ = ["Emulator", "Particles", "Scene", "Trajectory", "Zoo", "__version__", "rollout", "write_trajectories"]

_HOMES = {
    "Emulator": "nmpm.emulator",
    "Particles": "nmpm.particles",
    "Scene": "nmpm.scene",
    "Trajectory": "nmpm.data.format",
    "Zoo": "nmpm.zoo",
    "rollout": "nmpm.rollouts",
    "write_trajectories": "nmpm.data.convert.arrays",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'nmpm' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
