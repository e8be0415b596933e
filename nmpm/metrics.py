"""Errors of rollouts, as torchmetrics that accumulate over batches and processes.

*MSE at h*: the mean over predicted frames 1 … h, particles that move and dimensions, of the squared position error, in
domain length squared, from a rollout that starts with frames 0 and 1; *full* is h = T - 2. Averaged over trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class RolloutError(Metric):
    """Squared position error of each trajectory at each predicted frame, summed up as MSE at horizons.

    Args:
        horizons: Frames h at which the MSE is reported, beside the full rollout.
    """

    full_state_update = False
    squared: list[Tensor] | Tensor  # one tensor once gathered from several processes
    lengths: list[Tensor] | Tensor

    def __init__(self, horizons: Sequence[int] = (1, 8, 32, 100)) -> None:
        super().__init__()
        self.horizons = tuple(horizons)
        self.add_state("squared", default=[], dist_reduce_fx="cat")
        self.add_state("lengths", default=[], dist_reduce_fx="cat")

    def update(self, predicted: Tensor, target: Tensor, mask: Tensor) -> None:
        """Take in rollouts.

        Args:
            predicted: (B, T, N, D) positions in domain length.
            target: (B, T, N, D), likewise.
            mask: (B, N) bool, particles that count.
        """
        # Each frame in the positions' precision, as not every device has float64; sums over frames follow in `curves`.
        squared = (predicted - target).square().mean(-1) * mask.unsqueeze(1)
        per_frame = squared.sum(-1) / mask.sum(-1, keepdim=True)
        self.squared.append(per_frame.flatten().float())  # type: ignore[union-attr]  # (a list until gathered)
        self.lengths.append(  # type: ignore[union-attr]  # (likewise)
            torch.full((len(per_frame),), per_frame.shape[1], device=per_frame.device)
        )

    def curves(self) -> list[Tensor]:
        """One (T,) curve of squared error against frame for each trajectory, on the CPU."""
        if not len(self.lengths):
            return []
        lengths: list[int] = dim_zero_cat(self.lengths).tolist()
        return list(dim_zero_cat(self.squared).cpu().split(lengths))

    def per_trajectory(self) -> list[dict[str, float]]:
        """MSE at each horizon that the trajectory reaches, and over the full rollout ("mse")."""
        return [self._at_horizons(curve.double()) for curve in self.curves()]

    def compute(self) -> dict[str, Tensor]:
        """Means over trajectories, by the names "mse@h" and "mse"."""
        rows = self.per_trajectory()
        names = list(dict.fromkeys(name for row in rows for name in row))
        means = {name: np.mean([row[name] for row in rows if name in row]) for name in names}
        return {name: torch.tensor(value, dtype=torch.float32) for name, value in means.items()}

    def _at_horizons(self, curve: Tensor) -> dict[str, float]:
        row = {f"mse@{h}": float(curve[:h].mean()) for h in self.horizons if h <= len(curve)}
        return row | {"mse": float(curve.mean())}


class EarthMover(Metric):
    """Exact earth mover's distance: the mean distance to the best one-to-one match, per material, every n-th frame.

    In domain length, averaged over the frames looked at, then over materials, then over trajectories. The cost is
    Euclidean and the match exact (linear assignment), unlike the entropic approximations that papers often quote.

    Args:
        every: Look at frames every, 2 every, …
    """

    full_state_update = False
    distances: list[Tensor] | Tensor  # one tensor once gathered from several processes

    def __init__(self, every: int = 10) -> None:
        super().__init__()
        self.every = every
        self.add_state("distances", default=[], dist_reduce_fx="cat")

    def update(self, predicted: Tensor, target: Tensor, mask: Tensor, material: Tensor) -> None:
        """Take in rollouts: (B, T, N, D) positions, (B, N) mask and material. Computed on the CPU."""
        frames = slice(self.every - 1, None, self.every)
        on_cpu = (values.cpu() for values in (predicted[:, frames], target[:, frames], mask, material))
        means = []
        for ours, theirs, real, kinds in zip(*on_cpu, strict=True):
            each = [real & (kinds == kind) for kind in kinds[real].unique()]
            means.append(np.mean([earth_mover(ours[:, chosen], theirs[:, chosen]) for chosen in each]))
        found = torch.tensor(means, dtype=torch.float32, device=predicted.device)
        self.distances.append(found)  # type: ignore[union-attr]  # (a list until gathered)

    def compute(self) -> dict[str, Tensor]:
        """The mean over trajectories, by the name "emd"; nothing if there were none."""
        if not len(self.distances):
            return {}
        return {"emd": dim_zero_cat(self.distances).cpu().double().mean().float()}


def earth_mover(ours: Tensor, theirs: Tensor) -> float:
    """Mean over frames of the exact earth mover's distance between two clouds (T, N, D) of equal size."""
    values = []
    for left, right in zip(ours.cpu().double().numpy(), theirs.cpu().double().numpy(), strict=True):
        cost = cdist(left, right)
        values.append(cost[linear_sum_assignment(cost)].mean())
    return float(np.mean(values))
