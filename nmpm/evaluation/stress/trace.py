"""Measures along a rollout, frame by frame, kept without the positions: energy, speed, lost particles, volume."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.emulator import Emulator, stream_rollout
from nmpm.emulator.constraints import MOST_GAIN, lowest_potential, mass_shares
from nmpm.emulator.monitor import beyond_walls
from nmpm.emulator.rasterise import volume_fraction
from nmpm.grid import Grid
from nmpm.particles import Particles
from nmpm.scene import Scene

INVARIANTS = f"no particle lost, energy never more than {MOST_GAIN:.0%} above the start"
"""The invariants of `Trace.valid`, in words."""


@dataclass(frozen=True)
class Trace:
    """The measures of a rollout of B scenes over T frames.

    Args:
        gain: (B, T) kinetic and potential energy above the start's, over the start's.
        speed: (B, T) of the fastest particle, in cells per frame.
        lost: (B, T) number of particles outside of the domain, or non-finite.
        filled: (B, V) volume that the particles fill over their own, at the V frames at which it is measured.
        last: (B, N, D) positions at the end.
    """

    gain: Tensor
    speed: Tensor
    lost: Tensor
    filled: Tensor
    last: Tensor

    @property
    def failures(self) -> Tensor:
        """(B, T): whether an invariant is broken: a particle lost, or more energy gained than `MOST_GAIN`."""
        return (self.lost > 0) | (self.gain > MOST_GAIN) | self.gain.isnan()

    @property
    def valid(self) -> bool:
        """Whether the invariants hold at every frame."""
        return not bool(self.failures.any())

    def steps_to_failure(self) -> list[int]:
        """For each scene the first frame, from 1, at which an invariant is broken; T + 1 where none is."""
        first = self.failures.int().argmax(1) + 1
        return torch.where(self.failures.any(1), first, self.gain.shape[1] + 1).tolist()

    def figures(self) -> dict[str, float]:
        """The figures that a line of the battery reports."""
        return {
            "energy_gain_percent": 100 * float(self.gain.max()),
            "lost": float(self.lost.max()),
            "cfl": float(self.speed.max()),
        }


def trace_bundles(emulator: Emulator, start: Particles, bundles: Iterable[Tensor], every: int = 0) -> Trace:
    """Measure a rollout bundle by bundle, (B, m, N, D) positions each.

    The volume is measured `every` so many frames, rounded up to bundles; never for 0.
    """
    scene, real = emulator.scene, start.mask
    begun = energy_above_lowest(scene, start, start.position.unsqueeze(1), start.velocity.unsqueeze(1))
    spacing = start.position.new_tensor(emulator.grid.spacing)
    negligible = (
        0.5 * (1e-6 * max(high - low for low, high in scene.domain)) ** 2
    )  # a millionth of the domain per frame
    gains, speeds, losses, volumes = [], [], [], []
    last, frame = start.position, 0
    for bundle in bundles:
        path = torch.cat([last.unsqueeze(1), bundle], dim=1)
        steps = path.diff(dim=1)
        gains.append((energy_above_lowest(scene, start, bundle, steps) - begun) / begun.clamp(min=negligible))
        speed = torch.where(real.unsqueeze(1), (steps / spacing).norm(dim=-1), 0.0)
        speeds.append(speed.amax(-1) if real.shape[1] else speed.sum(-1))
        losses.append((is_lost(scene, bundle) & real.unsqueeze(1)).sum(-1))
        last = bundle[:, -1]
        if every and (frame + bundle.shape[1]) // every > frame // every:
            volumes.append(filled_volume(emulator, start, last))
        frame += bundle.shape[1]
    none = start.position.new_zeros(len(real), 0)
    gain, speed, lost = (torch.cat(parts, dim=1) if parts else none for parts in (gains, speeds, losses))
    volume = torch.stack(volumes, dim=1) if volumes else none
    return Trace(gain, speed, lost, volume, last)


def trace_rollout(emulator: Emulator, start: Particles, frames: int, every: int = 0) -> Trace:
    """Roll out and measure, keeping the last positions only."""
    positions = (part.position for part in stream_rollout(emulator, start, frames))
    return trace_bundles(emulator, start, positions, every)


def energy_above_lowest(scene: Scene, start: Particles, position: Tensor, velocity: Tensor) -> Tensor:
    """Kinetic and potential energy per mass of each scene, (B, T), the potential from the bounds' lowest corner.

    Counted from there particle by particle: in a sum of large potentials, far from the origin, digits would be lost.
    Positions and velocities, per frame, are (B, T, N, D).
    """
    gravity = start.gravity[:, None, None]
    lowest = lowest_potential(scene, start.gravity)[:, None, None]
    each = velocity.square().sum(-1) / 2 - lowest - (position * gravity).sum(-1)
    share = mass_shares(scene, start.material, start.present_volume, each.dtype).squeeze(-1).unsqueeze(1)
    return (torch.where(start.mask.unsqueeze(1), each, 0.0) * share).sum(-1)


def is_lost(scene: Scene, position: Tensor) -> Tensor:
    """Whether positions (..., D) are beyond the domain's walls, or not finite."""
    return beyond_walls(scene, position) | ~position.isfinite().all(-1)


def rms_distance(grid: Grid, mask: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Root mean square distance, (T,) in cells, of the same particles in two rollouts (B, T, N, D), over all scenes."""
    squared = ((one - other) / one.new_tensor(grid.spacing)).square().sum(-1)
    return (torch.where(mask.unsqueeze(1), squared, 0.0).sum((0, 2)) / mask.sum()).sqrt()


def filled_volume(emulator: Emulator, start: Particles, position: Tensor) -> Tensor:
    """(B,) volume that the particles occupy over the sum of their own; it falls where they clump.

    A cell counts with the share of it that particles fill, and a crowded one as full.
    """
    grid, scene = emulator.grid, emulator.scene
    cells = grid.to_cells(torch.where(start.mask.unsqueeze(-1), position, position.new_tensor(scene.domain).mean(1)))
    fraction = volume_fraction(scene, grid, emulator.transfer, start.present_volume, cells)
    volume = start.present_volume.sum(-1) * (scene.particle_volume / grid.cell_volume)
    return fraction.clamp(max=1.0).flatten(1).sum(1) / volume
