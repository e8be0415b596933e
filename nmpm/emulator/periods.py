"""Whole periods that particles have travelled: a rollout calls the emulator with positions within the domain.

Along periodic axes trajectories are unwrapped. In float32 the steps of a slow particle would be lost to the rounding of
its position after some tens of periods. So the periods are counted, and added only to what a rollout yields.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from nmpm.emulator.bundle import Bundle
from nmpm.emulator.model import Emulator
from nmpm.particles import Particles


class Periods:
    """The periods that a rollout's particles are away from the domain. Without periodic axes, nothing changes."""

    def __init__(self, emulator: Emulator) -> None:
        self._domain = emulator.scene.domain
        self._axes = [axis for axis in range(emulator.scene.dim) if _may_wrap(emulator, axis)]
        self._turns: dict[int, Tensor] = {}

    def wrap(self, particles: Particles) -> Particles:
        """The particles within the domain; the periods taken off are counted."""
        if not self._axes:
            return particles
        columns = list(particles.position.unbind(-1))
        for axis in self._axes:
            low, high = self._domain[axis]
            turns = torch.floor((columns[axis].detach() - low) / (high - low))
            columns[axis] = columns[axis] - turns * (high - low)
            self._turns[axis] = self._turns[axis] + turns if axis in self._turns else turns
        wrapped = particles.with_motion(torch.stack(columns, dim=-1), particles.velocity)
        return wrapped.with_budget(particles.budget)

    def forget(self, particles: Tensor) -> None:
        """Count from zero for some particles, True in (B, N): they are at another place."""
        self._turns = {axis: turns.masked_fill(particles, 0.0) for axis, turns in self._turns.items()}

    def unwrapped_state(self, particles: Particles) -> Particles:
        """Wrapped particles with the periods counted so far."""
        if not self._axes:
            return particles
        return particles.with_motion(self._with_turns(particles.position), particles.velocity)

    def unwrapped(self, bundle: Bundle) -> Bundle:
        """A bundle that starts from wrapped particles, with the periods counted until there."""
        if not self._axes:
            return bundle
        return dataclasses.replace(bundle, position=self._with_turns(bundle.position))

    def _with_turns(self, position: Tensor) -> Tensor:
        """Positions (B, N, D) or (B, m, N, D) with the periods counted so far."""
        columns = list(position.unbind(-1))
        for axis in self._axes:
            low, high = self._domain[axis]
            turns = self._turns[axis]
            columns[axis] = columns[axis] + (turns if position.dim() == 3 else turns.unsqueeze(1)) * (high - low)
        return torch.stack(columns, dim=-1)


def _may_wrap(emulator: Emulator, axis: int) -> bool:
    """Whether an axis is periodic, and its positions count for nothing: energies are those of unwrapped positions."""
    scene = emulator.scene
    falls = scene.gravity_varies or (scene.gravity is not None and scene.gravity[axis] != 0)
    return scene.periodic[axis] and not (emulator.constraints.energy and falls)
