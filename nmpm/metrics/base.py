"""The contract of rollout metrics: torchmetrics that take whole rollouts and add up over batches and processes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor
from torchmetrics import Metric

from nmpm.particles import Window


class RolloutMetric(Metric, ABC):
    """A measure of rollouts against recorded trajectories. Subclasses declare their states by `add_state`."""

    cheap: ClassVar[bool] = True
    """Whether validations compute it; tests compute every metric."""

    compared: ClassVar[bool] = True
    """Whether it is computed for the trivial predictors too."""

    full_state_update = False

    @abstractmethod
    def update(self, window: Window, predicted: Tensor) -> None:
        """Add rollouts.

        Args:
            window: B recorded trajectories of T + 2 frames, of the data where these have only some of the model's.
            predicted: (B, T, N, D) positions in domain length, from the window's first two frames.
        """

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """Means over all trajectories added, by the names under which they are reported."""
