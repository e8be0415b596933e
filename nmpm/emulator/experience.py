"""What a model has seen in its training, and what data hold, in cells and frames: gravity, speeds, particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import torch

from nmpm.emulator.calibration import channel_values
from nmpm.emulator.model import UNLIMITED, Emulator
from nmpm.scene import Interval, Motion, Scene

_SPACING = 1.5
"""Factor by which the spacing of particles may differ from the training's where the recipe states no range."""
_SPACING_WEIGHT = 0.05
"""Weight of the particles' spacing beside gravity, within a range that the recipe states; outside it is 1."""
_WEAK = 0.5
"""A model that is told gravity is matched to this share of its root mean square, or more."""


@dataclass(frozen=True)
class Figures:
    """A scene of the data in cells and frames of a model.

    Args:
        gravity: |g| Δt²/h, in cells per frame²; None where it is unknown or zero.
        rms, largest: Speeds, in cells per frame; None where they are unknown.
        spacing: Distances between particles to a cell and axis.
    """

    gravity: float | None
    rms: float | None
    largest: float | None
    spacing: float

    @classmethod
    def of(cls, scene: Scene, motion: Motion, widths: Sequence[float], stride: Fraction) -> Figures:
        """The figures on cells of some widths (D,), in the data's units, with so many frames of the data for one."""
        width, frames = mean_width(widths), float(stride)
        gravity = gravity_in_cells(scene.gravity or motion.gravity, scene.dt, widths)
        rms, largest = (each and each * frames / width for each in (motion.rms, motion.largest))
        return cls(gravity and gravity * frames**2, rms, largest, width / scene.particle_spacing)

    def scaled(self, factor: float) -> Figures:
        """The figures on cells wider by a factor."""
        gravity, rms, largest = (each and each / factor for each in (self.gravity, self.rms, self.largest))
        return Figures(gravity, rms, largest, self.spacing * factor)


@dataclass(frozen=True)
class Experience:
    """The figures of a model's training.

    Args:
        gravity: Weakest and strongest gravity that counts as matched, in cells per frame²; None where it is unknown or
            zero.
        rms: Root mean square speed in filled cells, in cells per frame; None for an uncalibrated model.
        fastest: Speed up to which the model is calibrated, likewise.
        spacing: Distances between particles to a cell and axis, in the scene of the training.
        spacings: Fewest and most of them.
        varied_spacing: Whether the training had all of these.
    """

    gravity: Interval | None
    rms: float | None
    fastest: float | None
    spacing: float
    spacings: Interval
    varied_spacing: bool

    @classmethod
    def of(cls, emulator: Emulator) -> Experience:
        """The figures of a model, from its scene and its normalisation statistics."""
        scene, stated = emulator.scene, emulator.recipe.particles_per_cell
        spacing = mean_width(emulator.grid.spacing) / scene.particle_spacing
        few, most = (n ** (1 / scene.dim) for n in stated) if stated else (spacing / _SPACING, spacing * _SPACING)
        return cls(
            gravity=_gravities(emulator),
            rms=_rms_speed(emulator),
            fastest=_fastest(emulator),
            spacing=spacing,
            spacings=(min(few, spacing), max(most, spacing)),
            varied_spacing=stated is not None,
        )

    @property
    def spacing_weight(self) -> float:
        """Weight of the spacing's factor over the training's beside that of gravity."""
        return _SPACING_WEIGHT if self.varied_spacing else 1.0

    def motion_factor(self, data: Figures) -> float:
        """Gravity over the nearest that the model has seen; without any, speeds over the model's; 1 if unknown."""
        if data.gravity and self.gravity:
            return data.gravity / clamp(data.gravity, *self.gravity)
        return data.rms / self.rms if data.rms and self.rms else 1.0

    def speed_excess(self, data: Figures) -> float:
        """The data's largest speed over that up to which the model is calibrated; 0 where either is unknown."""
        return data.largest / self.fastest if data.largest and self.fastest else 0.0


def clamp(value: float, low: float, high: float) -> float:
    """The value, or the nearer end of an interval that it is not in."""
    return max(low, min(value, high))


def mean_width(widths: Sequence[float]) -> float:
    """The geometric mean of a cell's widths; exactly their value where they are the same."""
    return widths[0] if len(set(widths)) == 1 else math.prod(widths) ** (1 / len(widths))


def gravity_in_cells(gravity: Sequence[float] | None, dt: float, widths: Sequence[float]) -> float | None:
    """|g| Δt²/h; None where gravity is unknown or zero."""
    if not gravity or not any(gravity):
        return None
    return math.hypot(*(g / h for g, h in zip(gravity, widths, strict=True))) * dt**2


def _gravities(emulator: Emulator) -> Interval | None:
    if not emulator.scene.gravity_varies:
        only = gravity_in_cells(emulator.scene.gravity, emulator.scene.dt, emulator.grid.spacing)
        return None if only is None else (only, only)
    rms = math.sqrt(_mean_square(emulator, "gravity_"))
    if not emulator.calibrated or not rms:
        return None
    # The limits are the sampled range, widened by half of it on either side.
    low, high = (channel_values(emulator, limit, "gravity_") for limit in (emulator.input_low, emulator.input_high))
    sampled = torch.maximum((3 * low + high).abs(), (low + 3 * high).abs()) / 4
    return _WEAK * rms, max(rms, float(sampled[sampled < UNLIMITED / 4].amax()))


def _rms_speed(emulator: Emulator) -> float | None:
    """The root mean square speed where there is material: velocities are zero in empty cells."""
    names = emulator.scene.materials
    filled = sum(float(channel_values(emulator, emulator.input_mean, f"{name}.volume").sum()) for name in names)
    square = sum(_mean_square(emulator, f"{name}.velocity_") for name in names)
    return math.sqrt(square / filled) if emulator.calibrated and filled > 0 and square > 0 else None


def _fastest(emulator: Emulator) -> float | None:
    """The largest component of a velocity that is not clipped."""
    ends = [
        channel_values(emulator, end, f"{name}.velocity_").abs()
        for name in emulator.scene.materials
        for end in (emulator.input_low, emulator.input_high)
    ]
    limits = torch.cat(ends)
    limits = limits[limits < UNLIMITED / 2]
    return float(limits.amax()) if len(limits) else None


def _mean_square(emulator: Emulator, prefix: str) -> float:
    mean, std = (channel_values(emulator, each, prefix) for each in (emulator.input_mean, emulator.input_std))
    return float((mean.square() + std.square()).sum())
