"""What a player may do in a model's scenes: numbers beyond that are refused in one line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.emulator.calibration import calibrated_range
from nmpm.errors import ConfigError
from nmpm.play.placing import Pour

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained

MOST_PARTICLES = 20_000
"""In a scene; fewer where the box holds fewer."""
_FILLED = 0.8
"""Share of the box that particles may fill."""
LARGEST_SEED = 2**31 - 1


class SceneLimits:
    """The limits of a model's scenes.

    Attributes:
        fastest: (materials, D) largest speeds in length per second, those that the model was calibrated for.
        most_particles: In a scene.
    """

    def __init__(self, model: Pretrained) -> None:
        self.scene, self.fastest = model.scene, _fastest(model)
        self.most_particles = min(MOST_PARTICLES, int(_FILLED * self.scene.volume / self.scene.particle_volume))
        self._sides = [high - low for low, high in self.scene.bounds]

    def check_throw(
        self, material: int, at: Sequence[float], sides: Sequence[float], velocity: Sequence[float]
    ) -> None:
        """Raise ConfigError for a block of another material, too large, or too fast."""
        self._check_material(material)
        self.check_vector("at", at)
        self.check_vector("sides", sides)
        self._check_velocity(material, velocity)
        width, most = _numbers(sides), max(self._sides)
        if not all(0 < side <= most for side in sides):
            raise ConfigError(f"a block {width} wide: each side must be positive, and at most {most:g}")
        if math.prod(sides) / self.scene.particle_volume > self.most_particles:
            raise ConfigError(f"a block {width} wide has more than {self.most_particles} particles")

    def check_pour(self, pour: Pour) -> None:
        """Raise ConfigError for a jet of another material, too wide, too fast, or at rest."""
        self._check_material(pour.material)
        self.check_vector("at", pour.at)
        self._check_velocity(pour.material, pour.velocity)
        widest = min(self._sides) / 2
        if not 0 < pour.width <= widest:
            raise ConfigError(f"width = {pour.width:g} must be positive, and at most {widest:g}")
        if not any(pour.velocity):
            raise ConfigError("what is poured needs a velocity")

    def check_vector(self, name: str, vector: Sequence[float]) -> None:
        """Raise ConfigError unless there is a number for each axis."""
        if len(vector) != self.scene.dim:
            raise ConfigError(f"{name} has {len(vector)} numbers; this scene has {self.scene.dim} axes")

    def check_seed(self, seed: int) -> None:
        """Raise ConfigError unless scenes can be drawn by it."""
        if not 0 <= seed <= LARGEST_SEED:
            raise ConfigError(f"seed = {one_line(seed, 30)} must be 0 … {LARGEST_SEED}")

    def _check_material(self, material: int) -> None:
        names = self.scene.materials
        if not 0 <= material < len(names):
            raise ConfigError(f"material = {one_line(material, 30)}: there are {len(names)}, {', '.join(names)}")

    def _check_velocity(self, material: int, velocity: Sequence[float]) -> None:
        self.check_vector("velocity", velocity)
        limits = self.fastest[material].tolist()
        if any(abs(part) > limit for part, limit in zip(velocity, limits, strict=True)):
            raise ConfigError(f"a velocity of {_numbers(velocity)} is beyond {_numbers(limits)}, which the model knows")


def _fastest(model: Pretrained) -> Tensor:
    """(materials, D) largest calibrated speeds in length per second, at most a tenth of the box in a frame."""
    scene = model.scene
    ranges = [calibrated_range(model.emulator, f"{name}.velocity_") for name in scene.materials]
    limits = torch.stack([torch.maximum(low.abs(), high.abs()) for low, high in ranges])
    sides = torch.tensor([high - low for low, high in scene.bounds], dtype=torch.float64)
    return torch.minimum(limits.cpu().double(), sides / (10 * scene.dt))


def _numbers(values: Sequence[float]) -> str:
    return " × ".join(f"{value:.3g}" for value in values)
