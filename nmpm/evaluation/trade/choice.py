"""The interface of choices: whatever predicts scenes in a comparison of time and error."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import Any

import torch
from torch import Tensor

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


def digest(plain: Any) -> str:
    """A key of plain data: SHA-256 of its JSON, in short."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:20]
