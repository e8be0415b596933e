"""The trivial predictors as choices: nothing moves, and free fall."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from torch import Tensor

from nmpm.evaluation.baselines import free_fall, still
from nmpm.evaluation.trade.choice import Choice, Kind, Rollout
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.particles import Particles
from nmpm.scene import Scene

Predictor = Callable[[Scene, Particles, int], Tensor]

PREDICTORS: Mapping[str, Predictor] = MappingProxyType(
    {
        "nothing moves": lambda _, state, frames: still(state, frames).contiguous(),
        "free fall": free_fall,
    }
)


@dataclass(frozen=True, eq=False)
class TrivialChoice(Choice):
    """A trivial predictor.

    Args:
        name: One of `PREDICTORS`.
    """

    name: str
    kind: Kind = field(default=Kind.TRIVIAL, init=False)
    settings: Mapping[str, str | int | float] = field(default_factory=dict, init=False)
    batch: int = field(default=1, init=False)
    threads: int = field(default=1, init=False)

    @property
    def identity(self) -> Mapping[str, Any]:
        return {"trivial": self.name}

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        state, predict = scenes.window(indices, 0).initial, PREDICTORS[self.name]
        return lambda frames: predict(scenes.scene, state, frames)
