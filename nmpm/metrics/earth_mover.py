"""Exact earth mover's distance between predicted and recorded particles."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from torch import Tensor

from nmpm.metrics.base import RolloutMetric
from nmpm.particles import Window


class EarthMover(RolloutMetric):
    """Exact earth mover's distance: the mean distance to the best one-to-one match, per material, every n-th frame.

    In domain length, averaged over the frames looked at, then over materials, then over trajectories. The cost is
    Euclidean and the match exact (linear assignment), unlike the entropic approximations that papers often quote.

    Args:
        every: Compute it at frames every, 2 every, …
    """

    cheap: ClassVar[bool] = False
    compared: ClassVar[bool] = False

    total: Tensor
    count: Tensor

    def __init__(self, every: int = 10) -> None:
        super().__init__()
        self.every = every
        self.add_state("total", default=torch.zeros(()), dist_reduce_fx="sum")
        self.add_state("count", default=torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, window: Window, predicted: Tensor) -> None:
        frames = slice(self.every - 1, None, self.every)
        rows = zip(predicted, window.target, window.mask, window.material, strict=True)
        for ours, theirs, real, kinds in rows:
            distances = [
                earth_mover(ours[frames][:, real & (kinds == kind)], theirs[frames][:, real & (kinds == kind)])
                for kind in kinds[real].unique()
            ]
            self.total += float(np.mean(distances))
            self.count += 1

    def compute(self) -> dict[str, Tensor]:
        """The mean over trajectories, by the name "emd"; empty where no trajectory was added."""
        return {"emd": self.total / self.count} if self.count else {}


def earth_mover(ours: Tensor, theirs: Tensor) -> float:
    """Mean over frames of the exact earth mover's distance between two clouds (T, N, D) of as many particles."""
    values = []
    for left, right in zip(ours.double().cpu().numpy(), theirs.double().cpu().numpy(), strict=True):
        cost = cdist(left, right)
        values.append(cost[linear_sum_assignment(cost)].mean())
    return float(np.mean(values))
