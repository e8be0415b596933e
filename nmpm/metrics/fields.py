"""Mean squared error of evolving fields, beside that of the trivial prediction: each particle keeps its value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torchmetrics import Metric

from nmpm.particles import Window


class FieldMSE(Metric):
    """Mean over predicted frames, particles that move and trajectories, in the square of each field's unit.

    Args:
        names: Of the evolving fields.
    """

    full_state_update = False

    squared: Tensor
    constant: Tensor
    trajectories: Tensor

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        for state in ("squared", "constant", "trajectories"):
            self.add_state(state, default=torch.zeros(len(self.names)), dist_reduce_fx="sum")

    def update(self, window: Window, predicted: Mapping[str, Tensor]) -> None:
        """Add rollouts.

        Args:
            window: B recorded trajectories of T + 2 frames. Fields that they lack do not count.
            predicted: (B, T, N) by name, from the window's first two frames.
        """
        start = window.initial.fields
        for index, name in enumerate(self.names):
            if name in predicted and name in window.fields:
                target = window.field_target(name)
                self.squared[index] += _squared(predicted[name] - target, window.mask)
                self.constant[index] += _squared(start[name].unsqueeze(1) - target, window.mask)
                self.trajectories[index] += len(target)

    def compute(self) -> dict[str, Tensor]:
        """By the names "mse_FIELD", and "still/mse_FIELD" if each particle keeps its value."""
        found: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            if self.trajectories[index]:
                found[f"mse_{name}"] = self.squared[index] / self.trajectories[index]
                found[f"still/mse_{name}"] = self.constant[index] / self.trajectories[index]
        return found


def _squared(difference: Tensor, mask: Tensor) -> Tensor:
    """Sum over trajectories of the mean square of (B, T, N) differences over frames and real particles."""
    squared = difference.square() * mask.unsqueeze(1)
    return (squared.sum((1, 2)) / (mask.sum(1) * difference.shape[1])).sum()
