"""Fields beside motion: numbers that particles carry, such as a temperature, or that a scene has, such as a force.

On the grid a field of the particles is its mean over those of each material in a cell, as velocity is; a number of the
whole scene is constant. Fields enter in units of their spread in the training data about their mean there, so that
empty cells, and fields that a scene lacks, hold the mean. Evolving fields are predicted as rates: with r_1 … r_m the
grid's rates of a bundle's frames, s_i = s_{i-1} + g2p(r_i)(x_{i-1}), so that nothing smooths a particle's value.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn

from nmpm._support.collectives import all_gather
from nmpm.errors import DataError
from nmpm.particles import Particles, Window
from nmpm.scene import Scene


class FieldScales(nn.Module):
    """Mean and standard deviation of each of a scene's fields in the training data; no tensors where it has none."""

    mean: Tensor
    std: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene = scene
        if scene.fields:
            self.register_buffer("mean", torch.zeros(len(scene.fields)))
            self.register_buffer("std", torch.ones(len(scene.fields)))

    @property
    def spread(self) -> Mapping[str, Tensor]:
        """The standard deviation () of each field, by name."""
        return {name: self.std[index] for index, name in enumerate(self.scene.fields)}

    def warn_of_missing(self, particles: Particles) -> None:
        """Warn, once for each name, of fields that a state lacks, which then have their training mean."""
        for index, name in enumerate(self.scene.fields):
            if name in particles.fields:
                continue
            mean = float(self.mean[index])
            warnings.warn(
                f"The scene has no {name}, which the model was trained with; its training mean, {mean:.4g}, is used.",
                stacklevel=3,
            )

    def of_particles(self, particles: Particles) -> Tensor:
        """(B, N, P) the particles' fields in units of their spread; 0 for padding."""
        batch, count = particles.mask.shape
        if not self.scene.particle_fields:
            return torch.empty(batch, count, 0)
        columns = [self._scaled(name, particles).expand(batch, count) for name in self.scene.particle_fields]
        return torch.stack(columns, -1).masked_fill(~particles.mask.unsqueeze(-1), 0.0)

    def of_scene(self, particles: Particles) -> Tensor:
        """(B, G) the scenes' own numbers in units of their spread.

        Raises DataError if a state has one for each particle.
        """
        for name in self.scene.parameters:
            if name in particles.fields and particles.fields[name].shape[1] != 1:
                raise DataError(
                    f"The model was trained with one {name} for each trajectory; the state has one for each particle."
                )
        if not self.scene.parameters:
            return torch.empty(len(particles.mask), 0)
        return torch.cat([self._scaled(name, particles) for name in self.scene.parameters], dim=1)

    def _scaled(self, name: str, particles: Particles) -> Tensor:
        """(B, N) or (B, 1)."""
        index = self.scene.fields.index(name)
        if name not in particles.fields:
            return self.mean.new_zeros(len(particles.mask), 1)
        return (particles.fields[name].to(self.mean.dtype) - self.mean[index]) / self.std[index]

    def evolve(self, begun: Mapping[str, Tensor], gained: Tensor) -> dict[str, Tensor]:
        """The evolving fields in the frames of a bundle, (B, m, N) by name, from those at its start.

        `gained` (B, m, N, E) are the sums of the rates since then, in units of the fields' spread.
        """
        batch, _, count, _ = gained.shape
        fields = {}
        for index, name in enumerate(self.scene.evolving):
            first = begun.get(name, self.mean[index].expand(batch, 1)).expand(batch, count).unsqueeze(1)
            fields[name] = first + (self.std[index] * gained[..., index]).to(first.dtype)
        return fields


def warn_of_ignored(scene: Scene, given: Iterable[str]) -> None:
    """Warn, by name, of fields that a model's scene does not have, so that it ignores them."""
    ignored = [name for name in given if name not in scene.fields]
    if ignored:
        warnings.warn(
            f"The model was trained without {', '.join(ignored)} and ignores {'it' if len(ignored) == 1 else 'them'}.",
            stacklevel=3,
        )


def calibrate_fields(scales: FieldScales, windows: Sequence[Window], names: Sequence[str]) -> None:
    """Set mean and standard deviation of some fields from the real particles, or scenes, of training windows.

    Where several processes train together, all of them call this. A field that the windows lack is left as it is.
    """
    for name in names:
        index = scales.scene.fields.index(name)
        values = [_values(window, name) for window in windows if name in window.fields]
        sums = [(part.numel(), part.sum().item(), part.square().sum().item()) for part in values]
        parts = [part for of_rank in all_gather(sums) for part in of_rank]
        count, total, squares = (sum(column) for column in zip((0, 0.0, 0.0), *parts, strict=True))
        if count:
            mean = total / count
            deviation = max(squares / count - mean**2, 0.0) ** 0.5
            scales.mean[index] = mean
            # A field that is constant in the sample may well differ elsewhere.
            scales.std[index] = deviation if deviation > 1e-6 * abs(mean) else 1.0


def _values(window: Window, name: str) -> Tensor:
    """The values (K,) of a field, of real particles or of scenes, in float64 on the CPU."""
    values = window.fields[name].cpu().double()
    if values.shape[2] == 1:
        return values.flatten()
    real = window.mask.unsqueeze(1)
    if window.present is not None and values.shape[1] > 1:
        real = real & window.present
    return values[real.cpu().expand_as(values)]


def true_rates(scales: FieldScales, window: Window, frames: int) -> Tensor:
    """(B, m, N, E) changes of the evolving fields in the frames to predict, in units of the fields' spread.

    Zero where a window lacks a field, or it is constant in time.
    """
    batch, count = window.mask.shape
    rates = []
    for index, name in enumerate(scales.scene.evolving):
        values = window.fields.get(name)
        if values is None or values.shape[1] == 1:
            rates.append(scales.mean.new_zeros(batch, frames, count))
        else:
            rates.append(values[:, 1 : frames + 2].diff(dim=1) / scales.std[index])
    return torch.stack(rates, dim=-1)
