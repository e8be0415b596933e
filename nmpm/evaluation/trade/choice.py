"""The interface of choices: whatever predicts scenes in a comparison of time and error."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import torch
from torch import Tensor

from nmpm.errors import DataError
from nmpm.evaluation.trade.scenes import Scenes

Rollout = Callable[[int], Tensor]
"""From a number of frames to (B, frames, N, D) predicted positions, in domain length."""

CPU = torch.device("cpu")

OTHER_SCENES = " (of other scenes)"
"""Ends the name of a model that was trained on other scenes, in the settings."""


class Kind(StrEnum):
    """The kind of a choice; floors are drawn beside the others and never advised."""

    MODEL = "model"
    GRAPH = "graph"
    SIMULATOR = "simulator"
    TRIVIAL = "trivial"
    FLOOR = "floor"


@dataclass(frozen=True, eq=False)
class Prediction:
    """One predicted scene.

    Args:
        position: (1, T, N, D) of the recorded particles, in domain length.
        gain: Energy gain of the choice's own particles, see `errors.energy_gain`; None where these are the recorded
            ones, so that the positions tell it.
    """

    position: Tensor
    gain: float | None = None


class Choice(ABC):
    """One way of predicting scenes, at one setting.

    Args:
        kind: Kind of predictor.
        name: Unique among the choices that are compared.
        settings: Its settings, by column of the table.
        batch: Scenes predicted at once when it is timed; predictions do not depend on it.
        threads: Threads of torch when it is timed.
        device: Where it computes.
    """

    kind: Kind
    name: str
    settings: Mapping[str, str | int | float]
    batch: int = 1
    threads: int = 1
    device: torch.device = CPU

    @property
    @abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """Plain data on which its predictions depend, beside the scenes: the key of stored errors."""

    @abstractmethod
    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        """Load what the rollouts of some scenes start from, which is not timed.

        Returns:
            Predicts the frames after each scene's first two. It raises an NmpmError where it fails.
        """

    def computed_frames(self, frames: int) -> int:
        """Frames that a rollout of so many frames computes: the time of a frame is its time over these."""
        return frames

    def predict(self, scenes: Scenes, index: int, frames: int) -> Prediction:
        """Predict one scene, which is not timed.

        Raises:
            NmpmError: if it fails; a DataError if positions are not finite.
        """
        return Prediction(require_finite(self.prepare(scenes, [index])(frames).cpu().float()))


def require_finite(position: Tensor) -> Tensor:
    """The positions (B, T, N, D).

    Raises:
        DataError: if any is not finite, naming the first such frame.
    """
    broken = (~position.isfinite()).flatten(2).any(-1).any(0)
    if bool(broken.any()):
        raise DataError(f"Positions are not finite from predicted frame {int(broken.nonzero()[0, 0]) + 1} on.")
    return position


def digest(plain: Any) -> str:
    """A key of plain data: SHA-256 of its JSON, in short."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:20]
