"""Training losses: what a step reduces, by class name (`model.loss`); of the package, or of others.

A loss is a mean over the particles that count: where data have only some of the frames, these alone count; a bundle
without any has no error.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import TypeVar

import torch
from torch import Tensor

from nmpm.emulator import Emulator, Rollout
from nmpm.emulator.engines.rules import TRAINING_ERRORS, PositionPair, takes
from nmpm.emulator.prescribed import predicted_particles
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Window, scene_volumes
from nmpm.scene import Scene
from nmpm.transfer import Linear

T = TypeVar("T")

_FLOOR = 1e-4
"""Cells², added to errors before they are raised to a power: below a hundredth of a cell errors no longer count."""


@dataclass(frozen=True)
class Loss(ABC):
    """A training loss; a subclass is a frozen dataclass of plain values, which checkpoints store.

    `nmpm.testing.LossContract` has the tests that every loss must pass.
    """

    @abstractmethod
    def __call__(self, predicted: Rollout, window: Window, emulator: Emulator) -> Tensor:
        """The loss (), a mean over the particles that count (`counted`), with gradients to the predictions.

        Args:
            predicted: (B M, K m, N, D) positions, and (B M, K m, N) evolving fields by name: M members of each window,
                one after the other.
            window: B recorded windows, of at least K m frames after the first two.
            emulator: Has made the predictions: gives scene, grid, the m frames of a bundle, and the fields' scales.
        """

    def check_members(self, members: int) -> None:
        """Raise ConfigError if this loss cannot train so many members of each window; by default, if several."""
        if members < 1:
            raise ConfigError(f"model.members = {members}: 1 is a deterministic model, 2 or more an ensemble.")
        if members > 1:
            raise ConfigError(f"model.members = {members}: {type(self).__name__} scores one prediction of each window.")


@dataclass(frozen=True)
class PositionLoss(Loss):
    """Squared errors of positions, of the density that they make on the grid, and of evolving fields.

    Several members are scored together: by their mean distance to the truth, less half of the mean distance between two
    of them. In the mean it is least for members drawn from the distribution of the truth: neither too sure, nor too
    vague. It is fair: its mean does not depend on the number of members. Distances are of single particles (the energy
    score) and of single cells (the CRPS), each of which must be as uncertain as it is.

    Sources: Gneiting & Raftery, Strictly proper scoring rules, prediction, and estimation, JASA 2007 (energy score);
    Ferro, Fair scores for ensemble forecasts, QJRMS 2014.

    Args:
        power: In (0, 1], to which the position error, in cells², of each window and bundle is raised before the mean,
            as are those of fields. At 0.5, calm windows and early bundles weigh as much as splashes, whose errors
            nothing can reduce much; at 1, mean squares, which score no spread of members.
        density_weight: Weight of the density error at each bundle's last frame, by which liquids keep their volume; 0
            for none.
        field_weight: Weight of the error of evolving fields, such as a temperature, in units of their spread.
    """

    power: float = 0.5
    density_weight: float = 4.0
    field_weight: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1:
            raise ConfigError(f"model.loss.power = {self.power} must be above 0 and at most 1.")

    def check_members(self, members: int) -> None:
        if members < 2:
            super().check_members(members)
        elif self.power == 1:
            raise ConfigError("model.loss.power = 1 scores no spread: ensembles need less, such as 0.5.")

    def __call__(self, predicted: Rollout, window: Window, emulator: Emulator) -> Tensor:
        scene, grid, bundle = emulator.scene, emulator.grid, emulator.frames
        frames, count = predicted.position.shape[1], len(predicted.position) // len(window.mask)
        members = [predicted.position] if count == 1 else predicted.position.unflatten(0, (-1, count)).unbind(1)
        target = window.target[:, :frames]
        check_comparable(members[0], target, bundle)
        distance = self._window_error if count == 1 else self._particle_error
        error = fair_score(members, target, partial(distance, window, grid, bundle))
        if self.density_weight:
            last, there = last_frames(window, frames, bundle)
            ends, truth = [one[last] for one in members], target[last]
            if count == 1:
                density = density_error(ends[0], truth, window, scene, grid, there)
            else:
                density = density_score(ends, truth, window, scene, grid, there)
            error = error + self.density_weight * density
        if self.field_weight and predicted.fields:
            names = [name for name in predicted.fields if name in window.fields]
            split = {name: predicted.fields[name].unflatten(0, (-1, count)).unbind(1) for name in names}
            fields = [{name: values[member] for name, values in split.items()} for member in range(count)]
            true_fields = {name: window.field_target(name)[:, :frames] for name in names}
            spread = emulator.field_scales.spread
            of_fields = partial(field_error, window=window, spread=spread, frames=bundle, power=self.power)
            error = error + self.field_weight * fair_score(fields, true_fields, of_fields)
        return error

    def _window_error(self, window: Window, grid: Grid, bundle: int, predicted: Tensor, target: Tensor) -> Tensor:
        """The mean () over windows and bundles of the power of their position errors."""
        if _some_are_missing(window):
            counts = counted(window, predicted.shape[1], bundle)
            squared = grid.to_cell_displacement(predicted - target, predicted.dtype).square().mean(-1)
            return _tempered_mean(squared, counts, bundle, self.power)
        if self.power == 1:
            return position_error(predicted, target, window.mask, grid)
        return tempered_error(position_errors(predicted, target, window.mask, grid, bundle), window.mask, self.power)

    def _particle_error(self, window: Window, grid: Grid, bundle: int, one: Tensor, other: Tensor) -> Tensor:
        """The mean () over particles and frames of the power of their position errors."""
        counts = counted(window, one.shape[1], bundle).view(len(one), -1, one.shape[2]).expand(one.shape[:3])
        squared = grid.to_cell_displacement(one - other, one.dtype).square().mean(-1)
        return (tempered(squared, self.power) * counts).sum() / counts.sum().clamp(min=1)


def fair_score(members: Sequence[T], truth: T, distance: Callable[[T, T], Tensor]) -> Tensor:
    """The mean distance of members to the truth, less half of that between two of them where there are several."""
    if len(members) == 1:
        return distance(members[0], truth)
    skill = torch.stack([distance(member, truth) for member in members]).mean(0)
    spread = torch.stack([distance(one, other) for one, other in combinations(members, 2)]).mean(0)
    return skill - spread / 2


def counted(window: Window, frames: int, bundle: int) -> Tensor:
    """The particles whose errors count: `mask` (B, N), or (B, frames, N) where some are missing, or frames are."""
    if not _some_are_missing(window):
        return window.mask
    counts = window.mask.unsqueeze(1)
    if window.present is not None:
        counts = counts & predicted_particles(window.present, bundle)[:, :frames]
    return counts if window.observed is None else counts & window.observed[:, 2 : 2 + frames, None]


def _some_are_missing(window: Window) -> bool:
    """Whether particles enter or leave, or some frames were not observed."""
    return window.present is not None or window.observed is not None


def last_frames(window: Window, frames: int, bundle: int) -> tuple[tuple[slice | Tensor, ...], Tensor | None]:
    """The last frame of each bundle, as an index of (B, frames, …), and the particles (B, K, N) that count there.

    That of the last one that was observed, where frames are missing; None for particles that are all there.
    """
    last: tuple[slice | Tensor, ...] = (slice(None), slice(bundle - 1, None, bundle))
    if not _some_are_missing(window):
        return last, None
    if window.observed is not None:
        last = _last_observed(window.observed[:, 2 : 2 + frames], bundle)
    return last, counted(window, frames, bundle)[last]


def _last_observed(observed: Tensor, bundle: int) -> tuple[Tensor, Tensor]:
    """Indices (B, 1) and (B, K) of the last frame of each bundle of `observed` (B, K m); the last one if none was."""
    backwards = observed.unflatten(1, (-1, bundle)).flip(2).int()
    ends = torch.arange(bundle - 1, observed.shape[1], bundle, device=observed.device)
    return torch.arange(len(observed), device=observed.device).unsqueeze(1), ends - backwards.argmax(2)


def _tempered_mean(values: Tensor, counts: Tensor, frames: int, power: float) -> Tensor:
    """`tempered_error` of the means over bundles of (B, T, N) values where `counts` (B, T, N); 0 if none does."""
    number = counts.sum(-1).unflatten(1, (-1, frames)).sum(-1)
    errors = (values * counts).sum(-1).unflatten(1, (-1, frames)).sum(-1) / number.clamp(min=1)
    mean: Tensor = (tempered(errors, power) * number).sum() / number.sum().clamp(min=1)
    return mean


def field_error(
    predicted: Mapping[str, Tensor],
    target: Mapping[str, Tensor],
    window: Window,
    spread: Mapping[str, Tensor],
    frames: int,
    power: float = 1.0,
) -> Tensor:
    """The error () of evolving fields (B, K m, N) in units of their spread: a mean over particles, summed over fields.

    Fields that have no target are left out.
    """
    total = torch.zeros((), device=window.mask.device)
    for name, values in target.items():
        squared = ((predicted[name] - values) / spread[name]).square()
        if _some_are_missing(window):
            total = total + _tempered_mean(squared, counted(window, values.shape[1], frames), frames, power)
            continue
        total = total + tempered_error(_bundle_means(squared, window.mask, frames), window.mask, power)
    return total


def position_error(predicted: Tensor, target: Tensor, mask: Tensor, grid: Grid) -> Tensor:
    """Mean () over frames, real particles and dimensions of the squared error of positions (B, T, N, D), in cells².

    NaN without real particles.
    """
    check_comparable(predicted, target, frames=1)
    squared = grid.to_cell_displacement(predicted - target, predicted.dtype).square() * mask[:, None, :, None]
    return squared.sum() / (mask.sum() * predicted.shape[1] * predicted.shape[3])


def position_errors(predicted: Tensor, target: Tensor, mask: Tensor, grid: Grid, frames: int) -> Tensor:
    """`position_error` of each of B windows and of each bundle of `frames` frames, (B, T / frames)."""
    check_comparable(predicted, target, frames)  # (kernels check no bounds)
    if takes(TRAINING_ERRORS, PositionPair(predicted, target, grid)):
        from nmpm.training.kernels import PositionErrors

        errors: Tensor = PositionErrors.apply(predicted, target, mask, grid, frames)  # type: ignore[no-untyped-call]
        return errors
    return _bundle_means(grid.to_cell_displacement(predicted - target, predicted.dtype).square().mean(-1), mask, frames)


def _bundle_means(values: Tensor, mask: Tensor, frames: int) -> Tensor:
    """Means over the particles of each window and over `frames` frames: (B, T / frames) of (B, T, N) values."""
    bundles: Tensor = (values * mask.unsqueeze(1)).sum(-1).unflatten(1, (-1, frames))
    return bundles.mean(-1) / mask.sum(1, keepdim=True)


def check_comparable(predicted: Tensor, target: Tensor, frames: int) -> None:
    """Raise ValueError if predicted positions (B, T, N, D) differ in shape from their target, or a bundle is cut."""
    if predicted.shape != target.shape:
        raise ValueError(f"Predicted {tuple(predicted.shape)} and target {tuple(target.shape)} positions do not match.")
    if predicted.shape[1] % frames:
        raise ValueError(f"{predicted.shape[1]} predicted frames are no whole number of bundles of {frames} frames.")


def tempered_error(errors: Tensor, mask: Tensor, power: float) -> Tensor:
    """Mean over real particles and bundles of (error + floor) ** power, for errors (B, K) of windows and bundles."""
    count = mask.sum(1, keepdim=True)
    return (tempered(errors, power) * count).sum() / (count.sum() * errors.shape[1])


def tempered(errors: Tensor, power: float) -> Tensor:
    """(error + floor) ** power of squared errors; the errors themselves for a power of 1."""
    return errors if power == 1 else (errors + _FLOOR).pow(power)


def density_error(
    predicted: Tensor, target: Tensor, window: Window, scene: Scene, grid: Grid, there: Tensor | None = None
) -> Tensor:
    """Squared error of each material's volume fraction φ on the grid, Σ (φ' - φ)² / (2 Σ φ) over frames and cells.

    Position errors hardly notice a liquid that slowly loses its volume, as neighbours swap places all the time; its
    density tells. As Σ φ is the particles' volume, the error is a mean over particles, as the position error is.

    Positions are (B, F, N, D), at F frames; `there`, (B, F, N), are the particles that count in each, the real ones if
    None.
    """
    predicted_fraction, true_fraction = (
        volume_fractions(position, window, scene, grid, there) for position in (predicted, target)
    )
    size = 1.0 if window.volume is None else window.volume.unsqueeze(1)
    counting = window.mask.unsqueeze(1) if there is None else there
    total = (size * counting).sum() * (predicted.shape[1] if there is None else 1)
    fraction = scene.particle_volume / grid.cell_volume
    error: Tensor = (predicted_fraction - true_fraction).square().sum() / (2 * fraction * total.clamp(min=1e-30))
    return error


def density_score(
    members: Sequence[Tensor], target: Tensor, window: Window, scene: Scene, grid: Grid, there: Tensor | None
) -> Tensor:
    """The fair CRPS () of cells' volume fractions, over twice their sum; arguments as of `density_error`."""
    ours = [volume_fractions(member, window, scene, grid, there) for member in members]
    theirs = volume_fractions(target, window, scene, grid, there)
    score = fair_score(ours, theirs, lambda one, other: (one - other).abs().sum())
    return score / (2 * theirs.sum().clamp(min=torch.finfo(theirs.dtype).tiny))


def volume_fractions(position: Tensor, window: Window, scene: Scene, grid: Grid, there: Tensor | None = None) -> Tensor:
    """(B, F, nodes and materials) volume fractions by linear weights; arguments and gradients as of `density_error`."""
    cells, fraction = grid.to_cells(position, position.dtype), scene.particle_volume / grid.cell_volume
    kernels = there is None and takes(TRAINING_ERRORS, PositionPair(position, position.detach(), grid))
    if kernels and (sizes := scene_volumes(window.volume, window.mask)) is not None:
        from nmpm.training.kernels import Counts

        numbers: Tensor = Counts.apply(cells, window.material, window.mask, grid, len(scene.materials))  # type: ignore[no-untyped-call]
        return (fraction * sizes.view(-1, 1, 1, 1) * numbers).flatten(2)
    kinds = torch.arange(len(scene.materials), device=window.material.device)
    there = window.mask.unsqueeze(1).expand(-1, position.shape[1], -1) if there is None else there
    volume = (window.material.unsqueeze(-1) == kinds).unsqueeze(1) & there.unsqueeze(-1)
    volume = (volume if window.volume is None else volume * window.volume[:, None, :, None]).to(position.dtype)
    sums = Linear().p2g(volume.flatten(0, 1), cells.flatten(0, 1), grid).flatten(1)
    fractions: Tensor = (fraction * sums).unflatten(0, position.shape[:2])
    return fractions
