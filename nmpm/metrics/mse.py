"""Rollout metrics: torchmetrics that take whole rollouts and add up over batches and processes; mean squared errors.

*MSE at h*: the mean over predicted frames 1 … h, particles that move and dimensions, of the squared position error, in
domain length squared, from a rollout that starts with frames 0 and 1; *full* is h = T - 2. Averaged over trajectories.
Evolving fields have an error of their own, over the full rollout.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from nmpm.particles import Window

_EMPTY = -1.0
"""Stands for the error of a frame in which there is no particle."""


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


def overall_error(errors: Mapping[str, Tensor], horizon: int) -> Tensor:
    """Geometric mean of the MSE at the horizons of at least so many frames and over the full rollout, ().

    Over the full rollout alone, a few scenes tell good weights from bad ones by chance.

    Args:
        errors: () by the names "mse@h" and "mse", from `MSE.compute`; others are left out.
        horizon: Frames from which on a rollout is longer than what a model was trained for.
    """
    horizons = {int(name.removeprefix("mse@")): value for name, value in errors.items() if name.startswith("mse@")}
    long = [errors["mse"], *(value for h, value in horizons.items() if h >= horizon)]
    return torch.stack(long).log().mean().exp()


class MSE(RolloutMetric):
    """Squared position error of each trajectory at each predicted frame, reported as MSE at horizons.

    Args:
        horizons: Frames h at which the MSE is reported, beside the full rollout.

    Attributes:
        every: Frames of the data, which horizons count, per frame of the rollouts.
    """

    squared: list[Tensor] | Tensor  # one tensor once gathered from several processes
    lengths: list[Tensor] | Tensor

    def __init__(self, horizons: Sequence[int] = (1, 8, 32, 100)) -> None:
        super().__init__()
        self.horizons, self.every = tuple(horizons), 1
        self.add_state("squared", default=[], dist_reduce_fx="cat")
        self.add_state("lengths", default=[], dist_reduce_fx="cat")

    def update(self, window: Window, predicted: Tensor) -> None:
        # Each frame in the positions' precision, as not every device has float64; sums over frames follow in `curves`.
        squared, there = (predicted - window.target).square().mean(-1), particles_there(window)
        number = there.sum(-1)
        per_frame = torch.where(there, squared, 0.0).sum(-1) / number.clamp(min=1)
        per_frame = torch.where(number > 0, per_frame, _EMPTY)
        self.squared.append(per_frame.flatten().float())  # type: ignore[union-attr]  # (a list until gathered)
        self.lengths.append(  # type: ignore[union-attr]  # (likewise)
            torch.full((len(per_frame),), per_frame.shape[1], device=per_frame.device)
        )

    def curves(self) -> list[Tensor]:
        """One (T,) curve of squared error against frame for each trajectory, on the CPU; NaN in frames without any."""
        return [torch.where(curve == _EMPTY, torch.nan, curve) for curve in self._stored()]

    def _stored(self) -> list[Tensor]:
        if not len(self.lengths):
            return []
        lengths: list[int] = dim_zero_cat(self.lengths).tolist()
        return list(dim_zero_cat(self.squared).cpu().split(lengths))

    def per_trajectory(self) -> list[dict[str, float]]:
        """MSE at each horizon that the trajectory reaches, and over the full rollout ("mse")."""
        return [self._at_horizons(curve.double()) for curve in self._stored()]

    def compute(self) -> dict[str, Tensor]:
        """Means over trajectories, by the names "mse@h" and "mse"."""
        rows = self.per_trajectory()
        names = list(dict.fromkeys(name for row in rows for name in row))
        means = {name: np.mean([row[name] for row in rows if name in row]) for name in names}
        return {name: torch.tensor(value, dtype=torch.float32) for name, value in means.items()}

    def _at_horizons(self, curve: Tensor) -> dict[str, float]:
        ends = {h: h // self.every for h in self.horizons}
        reached = {f"mse@{h}": curve[:end] for h, end in ends.items() if 0 < end <= len(curve)} | {"mse": curve}
        with_particles = {name: values[values != _EMPTY] for name, values in reached.items()}
        return {name: float(values.mean()) for name, values in with_particles.items() if len(values)}


class FieldMSE(Metric):
    """Mean squared error of evolving fields, in the square of their units, beside that of values that stay.

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
                self.squared[index] += _squared(predicted[name] - target, window)
                self.constant[index] += _squared(start[name].unsqueeze(1) - target, window)
                self.trajectories[index] += len(target)

    def compute(self) -> dict[str, Tensor]:
        """By the names "mse_FIELD", and "still/mse_FIELD" if each particle keeps its value."""
        errors: dict[str, Tensor] = {}
        for index, name in enumerate(self.names):
            if self.trajectories[index]:
                errors[f"mse_{name}"] = self.squared[index] / self.trajectories[index]
                errors[f"still/mse_{name}"] = self.constant[index] / self.trajectories[index]
        return errors


def _squared(difference: Tensor, window: Window) -> Tensor:
    """Sum over trajectories of the mean square of (B, T, N) differences over frames and the particles there."""
    there = particles_there(window)
    squared = torch.where(there, difference.square(), 0.0)
    return (squared.sum((1, 2)) / there.sum((1, 2)).clamp(min=1)).sum()


def particles_there(window: Window) -> Tensor:
    """(B, T, N) bool, which particles are there in the frames to predict."""
    mask = window.mask.unsqueeze(1)
    return mask.expand(-1, window.target.shape[1], -1) if window.present is None else window.present[:, 2:] & mask
