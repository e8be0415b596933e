"""Grid-based emulators of particle simulations, trained with Lightning, with a zoo of pretrained models.

The public names are imported when first used, so that `import nmpm` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nmpm._support import __version__

if TYPE_CHECKING:
    from nmpm.data.datamodule import TrajectoryDataModule as TrajectoryDataModule
    from nmpm.data.dataset import load_trajectories as load_trajectories
    from nmpm.data.dataset import write_trajectories as write_trajectories
    from nmpm.data.format import Trajectory as Trajectory
    from nmpm.emulator import Emulator as Emulator
    from nmpm.emulator import EmulatorRecipe as EmulatorRecipe
    from nmpm.emulator import differentiable_rollout as differentiable_rollout
    from nmpm.emulator import rollout as rollout
    from nmpm.particles import Particles as Particles
    from nmpm.scene import Scene as Scene
    from nmpm.training.module import EmulatorModule as EmulatorModule
    from nmpm.viz.viewer import view as view
    from nmpm.zoo.registry import Zoo as Zoo

_MODULE_OF = {
    "Emulator": "nmpm.emulator",
    "EmulatorModule": "nmpm.training",
    "EmulatorRecipe": "nmpm.emulator",
    "Particles": "nmpm.particles",
    "Scene": "nmpm.scene",
    "Trajectory": "nmpm.data.format",
    "TrajectoryDataModule": "nmpm.data.datamodule",
    "Zoo": "nmpm.zoo",
    "differentiable_rollout": "nmpm.emulator",
    "load_trajectories": "nmpm.data.dataset",
    "rollout": "nmpm.emulator",
    "view": "nmpm.viz.viewer",
    "write_trajectories": "nmpm.data.dataset",
}

__all__ = [*_MODULE_OF, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'nmpm' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
