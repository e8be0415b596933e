"""Training scores of ensembles: what several predictions of each window are worth together.

A score is the members' mean distance to the truth, less half of the mean distance between two of them. In the mean it
is least for members drawn from the distribution of the truth: neither too sure, nor too vague. It is fair: its mean
does not depend on the number of members. Distances are of single particles and of single cells, each of which must be
as uncertain as it is.

Sources: Gneiting & Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 2007 (energy score); Ferro,
Fair scores for ensemble forecasts, QJRMS 2014.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeVar

import torch
from torch import Tensor

from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.training.losses import (
    TrainingError,
    check_comparable,
    counted,
    field_error,
    field_targets,
    last_frames,
    tempered,
    volume_fractions,
)

T = TypeVar("T")
B = TypeVar("B", Particles, Window)


@dataclass(frozen=True)
class EnsembleError:
    """The fair energy score of single particles' positions, with the fair CRPS of cells' densities where bundles end.

    Args:
        members: M, at least 2, of each window. They follow each other in a batch.
        error: Of one prediction: its power, below 1, and the weight of densities.
    """

    members: int
    error: TrainingError

    def __post_init__(self) -> None:
        if self.members < 2:
            raise ConfigError(f"model.members = {self.members}: 1 is a deterministic model, 2 or more an ensemble.")
        if self.error.power == 1:
            raise ConfigError("model.error_power = 1 scores no spread: ensembles need less, such as 0.5.")

    def __call__(self, predicted: Tensor, window: Window, scene: Scene, grid: Grid, frames: int) -> Tensor:
        """The score () of predicted positions (B M, K m, N, D), m frames to a bundle, as a mean over particles.

        Raises:
            ValueError: if the window has fewer frames than were predicted, or other particles.
        """
        target, members = window.target[:, : predicted.shape[1]], self._split(predicted)
        check_comparable(members[0], target, frames)
        counts = counted(window, target.shape[1], frames).view(len(target), -1, target.shape[2])
        counts = counts.expand(target.shape[:3])

        def distance(one: Tensor, other: Tensor) -> Tensor:
            squared = grid.to_cell_displacement(one - other, one.dtype).square().mean(-1)
            return (tempered(squared, self.error.power) * counts).sum() / counts.sum().clamp(min=1)

        error = fair_score(members, target, distance)
        if not self.error.density_weight:
            return error
        last, there = last_frames(window, predicted.shape[1], frames)
        ours = [volume_fractions(member[last], window, scene, grid, there) for member in members]
        theirs = volume_fractions(target[last], window, scene, grid, there)
        share = fair_score(ours, theirs, _distance) / (2 * theirs.sum().clamp(min=torch.finfo(theirs.dtype).tiny))
        return error + self.error.density_weight * share

    def of_fields(
        self, predicted: Mapping[str, Tensor], window: Window, spread: Mapping[str, Tensor], frames: int
    ) -> Tensor:
        """The score () of evolving fields (B M, K m, N) by name in units of their spread, summed over fields."""
        target, power = field_targets({n: self._split(v)[0] for n, v in predicted.items()}, window), self.error.power
        split = {name: self._split(predicted[name]) for name in target}
        members = [{name: values[member] for name, values in split.items()} for member in range(self.members)]
        return fair_score(members, target, lambda one, other: field_error(one, other, window, spread, frames, power))

    def _split(self, values: Tensor) -> Sequence[Tensor]:
        """The M members (B, …) of (B M, …)."""
        parts: Sequence[Tensor] = values.unflatten(0, (-1, self.members)).unbind(1)
        return parts


def training_error(members: int, density_weight: float, power: float) -> TrainingError | EnsembleError:
    """The error of a deterministic model for one member, the score of an ensemble for more."""
    error = TrainingError(density_weight, power)
    return error if members == 1 else EnsembleError(members, error)


def fair_score(members: Sequence[T], truth: T, distance: Callable[[T, T], Tensor]) -> Tensor:
    """The mean distance of at least two members to the truth, less half of that between two of them."""
    skill = torch.stack([distance(member, truth) for member in members]).mean(0)
    spread = torch.stack([distance(one, other) for one, other in combinations(members, 2)]).mean(0)
    return skill - spread / 2


def repeated(batch: B, members: int) -> B:
    """Each scene of a batch so many times, one after the other."""
    if members == 1:
        return batch
    return batch.scenes([scene for scene in range(len(batch.mask)) for _ in range(members)])


def _distance(one: Tensor, other: Tensor) -> Tensor:
    return (one - other).abs().sum()
