"""Training losses: squared errors of positions, of the density that they make on the grid, and of particles' fields.

The position errors of each window and bundle may be raised to a power below 1, so that splashes, whose errors nothing
can reduce much, do not drown what can be learnt elsewhere.

Where data have only some of the frames, these alone count; a bundle without any has no error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.emulator.engines.rules import TRAINING_ERRORS, PositionPair, takes
from nmpm.emulator.prescribed import predicted_particles
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.particles import Window, scene_volumes
from nmpm.scene import Scene
from nmpm.transfer import Linear

_FLOOR = 1e-4
"""Cells², added to errors before they are raised to a power: below a hundredth of a cell errors no longer count."""


@dataclass(frozen=True)
class TrainingError:
    """The position error, with the density error at the last frame of each bundle, of those that were observed.

    Args:
        density_weight: Weight of the density error beside the position error in cells².
        power: In (0, 1]; below 1, the position error of each window and bundle is raised to it before the mean; the
            density error, which keeps the volume of splashes, is not.
    """

    density_weight: float = 0.0
    power: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1:
            raise ConfigError(f"model.error_power = {self.power} must be above 0 and at most 1.")

    def __call__(self, predicted: Tensor, window: Window, scene: Scene, grid: Grid, frames: int) -> Tensor:
        """The error () of predicted positions (B, K m, N, D), m frames to a bundle, as a mean over particles.

        Raises:
            ValueError: if the window has fewer frames than were predicted, or other particles.
        """
        target = window.target[:, : predicted.shape[1]]
        error = self.of_positions(predicted, target, window, grid, frames)
        if not self.density_weight:
            return error
        last, there = last_frames(window, predicted.shape[1], frames)
        density = density_error(predicted[last], target[last], window, scene, grid, there)
        return error + self.density_weight * density

    def of_positions(self, predicted: Tensor, target: Tensor, window: Window, grid: Grid, frames: int) -> Tensor:
        """The error () of positions (B, K m, N, D) alone, against others of the window's particles."""
        check_comparable(predicted, target, frames)
        if _some_are_missing(window):
            counts = counted(window, predicted.shape[1], frames)
            squared = grid.to_cell_displacement(predicted - target, predicted.dtype).square().mean(-1)
            return _tempered_mean(squared, counts, frames, self.power)
        if self.power == 1:
            return position_error(predicted, target, window.mask, grid)
        return tempered_error(position_errors(predicted, target, window.mask, grid, frames), window.mask, self.power)

    def of_fields(
        self, predicted: Mapping[str, Tensor], window: Window, spread: Mapping[str, Tensor], frames: int
    ) -> Tensor:
        """`field_error` of predicted fields, with this power."""
        return field_error(predicted, field_targets(predicted, window), window, spread, frames, self.power)


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
    """Indices (B, 1) and (B, K) of the last frame of each bundle that was observed; the last one if none was.

    Args:
        observed: (B, K m) whether each frame was.
        bundle: m.
    """
    backwards = observed.unflatten(1, (-1, bundle)).flip(2).int()
    ends = torch.arange(bundle - 1, observed.shape[1], bundle, device=observed.device)
    return torch.arange(len(observed), device=observed.device).unsqueeze(1), ends - backwards.argmax(2)


def _tempered_mean(values: Tensor, counts: Tensor, frames: int, power: float) -> Tensor:
    """`tempered_error` of the means over bundles of (B, T, N) values where `counts` (B, T, N); 0 if none does."""
    number = counts.sum(-1).unflatten(1, (-1, frames)).sum(-1)
    errors = (values * counts).sum(-1).unflatten(1, (-1, frames)).sum(-1) / number.clamp(min=1)
    mean: Tensor = (tempered(errors, power) * number).sum() / number.sum().clamp(min=1)
    return mean


def field_targets(predicted: Mapping[str, Tensor], window: Window) -> dict[str, Tensor]:
    """The window's values (B, K m, N) of predicted fields; those that it lacks are left out."""
    names = [name for name in predicted if name in window.fields]
    return {name: window.field_target(name)[:, : predicted[name].shape[1]] for name in names}


def field_error(
    predicted: Mapping[str, Tensor],
    target: Mapping[str, Tensor],
    window: Window,
    spread: Mapping[str, Tensor],
    frames: int,
    power: float = 1.0,
) -> Tensor:
    """The error () of evolving fields in units of their spread: a mean over particles, summed over fields.

    Args:
        predicted: (B, K m, N) by name, m frames to a bundle. Fields that have no target are left out.
        target: Likewise.
        window: Says which particles count.
        spread: () of each field in the training data.
        frames: m.
        power: As of `TrainingError`.
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
    """Mean over frames, real particles and dimensions of the squared position error (), in cells².

    Args:
        predicted: (B, T, N, D) positions in domain length.
        target: (B, T, N, D), likewise.
        mask: (B, N) bool, False for padding. Without real particles, the error is NaN.
        grid: Gives the cells' size.

    Raises:
        ValueError: if the shapes differ.
    """
    check_comparable(predicted, target, frames=1)
    squared = grid.to_cell_displacement(predicted - target, predicted.dtype).square() * mask[:, None, :, None]
    return squared.sum() / (mask.sum() * predicted.shape[1] * predicted.shape[3])


def position_errors(predicted: Tensor, target: Tensor, mask: Tensor, grid: Grid, frames: int) -> Tensor:
    """`position_error` of each of B windows and of each bundle of `frames` frames, (B, T / frames)."""
    check_comparable(predicted, target, frames)  # (kernels check no bounds)
    if takes("numba", TRAINING_ERRORS, PositionPair(predicted, target, grid)):
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

    Args:
        predicted: (B, F, N, D) positions in domain length, at F frames.
        target: (B, F, N, D), likewise.
        window: Says which particles are real, of which material and size.
        scene: Gives the materials and a particle's volume.
        grid: Where densities are compared, by linear weights.
        there: (B, F, N) bool, which particles count in each frame; the real ones when left out.
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


def volume_fractions(position: Tensor, window: Window, scene: Scene, grid: Grid, there: Tensor | None = None) -> Tensor:
    """(B, F, nodes and materials) volume fractions by linear weights, of positions (B, F, N, D).

    Args and gradients as `density_error`.
    """
    cells, fraction = grid.to_cells(position, position.dtype), scene.particle_volume / grid.cell_volume
    kernels = there is None and takes("numba", TRAINING_ERRORS, PositionPair(position, position.detach(), grid))
    if kernels and (sizes := scene_volumes(window.volume, window.mask)) is not None:
        return (fraction * sizes.view(-1, 1, 1, 1) * _kernel_counts(cells, window, scene, grid)).flatten(2)
    volume = _volumes(window, position.shape[1], scene, there).to(position.dtype)
    sums = Linear().p2g(volume.flatten(0, 1), cells.flatten(0, 1), grid)
    fractions: Tensor = fraction * sums.flatten(1)
    by_frame: Tensor = fractions.unflatten(0, position.shape[:2])
    return by_frame


def _volumes(window: Window, frames: int, scene: Scene, there: Tensor | None) -> Tensor:
    """(B, F, N, M) volume of each particle, as a multiple of the scene's, at its material; 0 if it does not count."""
    kinds = torch.arange(len(scene.materials), device=window.material.device)
    there = window.mask.unsqueeze(1).expand(-1, frames, -1) if there is None else there
    member = (window.material.unsqueeze(-1) == kinds).unsqueeze(1) & there.unsqueeze(-1)
    return member if window.volume is None else member * window.volume[:, None, :, None]


def _kernel_counts(cells: Tensor, window: Window, scene: Scene, grid: Grid) -> Tensor:
    """The number of particles of each material on the nodes by linear weights, (B, F, size, M)."""
    from nmpm.training.kernels import Counts

    counts: Tensor = Counts.apply(cells, window.material, window.mask, grid, len(scene.materials))  # type: ignore[no-untyped-call]
    return counts
