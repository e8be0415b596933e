"""Emulators as choices: a trained model in a precision, with or without constraints, on finer or coarser grids."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import torch

from nmpm._support.digests import weights_digest
from nmpm.emulator import NETWORK_PRECISIONS, Emulator, rollout
from nmpm.errors import ConfigError
from nmpm.evaluation.trade.choice import CPU, Choice, Kind, Rollout
from nmpm.evaluation.trade.scenes import Scenes

CONSTRAINTS: Mapping[str, Callable[[Emulator], Emulator]] = MappingProxyType(
    {"held": lambda emulator: emulator, "free": Emulator.unconstrained}
)
"""With the model's own constraints, or without them, by name."""


@dataclass(frozen=True, eq=False)
class ModelChoice(Choice):
    """A trained emulator.

    Args:
        name: Unique among the choices.
        emulator: In evaluation mode.
        settings: What was chosen.
        batch, threads, device: See `Choice`.
    """

    name: str
    emulator: Emulator
    settings: Mapping[str, str | int | float]
    batch: int = 1
    threads: int = 1
    device: torch.device = CPU
    kind: Kind = field(default=Kind.MODEL, init=False)

    @property
    def identity(self) -> Mapping[str, Any]:
        runtime = self.emulator.runtime.name
        return {
            "recipe": self.emulator.recipe.to_dict(),
            "weights": weights_digest(self.emulator.state_dict()),
            "device": self.device.type,
        } | ({"runtime": runtime} if runtime != "eager" else {})  # (stored measurements of before are eager's)

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        state = scenes.window(indices, 0).to(self.device).initial
        return lambda frames: rollout(self.emulator, state, frames)

    def computed_frames(self, frames: int) -> int:
        return -(-frames // self.emulator.frames) * self.emulator.frames  # whole bundles


def over_scenes(name: str, emulator: Emulator, scenes: Scenes) -> Emulator:
    """The emulator itself, or rebuilt for these scenes if it was trained on others, see `EmulatorRecipe.over`.

    Raises:
        ConfigError: if it cannot take the scenes, naming it and the reason.
    """
    if not emulator.scene.differences(scenes.scene):
        return emulator
    try:
        return emulator.over(scenes.scene)
    except ConfigError as error:
        raise ConfigError(f"The model {name} cannot predict the scenes of {scenes.name}. {error}") from error


def with_precision(emulator: Emulator, name: str) -> Emulator:
    """The emulator with its network in a precision of `NETWORK_PRECISIONS`.

    Raises:
        ConfigError: if there is no such precision, or the network cannot have it.
    """
    return emulator.with_network(_find("precision", name, NETWORK_PRECISIONS))


def with_constraints(emulator: Emulator, name: str) -> Emulator:
    """The emulator in a form of `CONSTRAINTS`.

    Raises:
        ConfigError: if there is no such form.
    """
    form: Emulator = _find("constraints", name, CONSTRAINTS)(emulator)
    return form


def with_cells(emulator: Emulator, factor: float) -> Emulator:
    """The same weights on a grid of `factor` times as many cells along each axis.

    Raises:
        ConfigError: if the processor cannot take the grid.
    """
    cells = tuple(max(1, round(factor * n)) for n in emulator.grid.shape)
    if cells == emulator.grid.shape:
        return emulator
    return emulator.rebuilt(dataclasses.replace(emulator.recipe, cells=cells))


def _find(what: str, name: str, known: Mapping[str, Any]) -> Any:
    if name not in known:
        raise ConfigError(f"models.{what}: {name!r} is not one of {', '.join(known)}.")
    return known[name]
