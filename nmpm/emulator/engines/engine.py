"""The contract of engines: one call of an emulator in five steps, from the state to the bundle.

    rasterise   particles to the grid state
    network     the grid state to the velocities of the next m frames; by the emulator's runtime, the same everywhere
    fly         g2p and advection through the m frames, within bounds, energy and obstacles, and rest
    spread      overfull cells at the path's end
    land        positions and velocities in domain length

All engines compute the same, to rounding; the torch engine is the reference.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.engines.numba.parameters import KernelParameters
    from nmpm.emulator.model import Emulator

Start = TypeVar("Start")
"""Particles and grid state at a bundle's start, as an engine holds them; in cells and cells per frame."""
Values = TypeVar("Values")
"""What an engine computes with: tensors or arrays."""


@dataclass(frozen=True)
class Flight(Generic[Values]):
    """The way of the particles through a bundle.

    Args:
        path: (B, m, N, D) positions in cells.
        step: (B, N, D) the last frame's step in cells, without spreading, which is no motion of the material.
        fields: (B, m, N) of each evolving field, by name, in its own unit.
    """

    path: Values
    step: Values
    fields: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Engine(ABC, Generic[Start, Values]):
    """Computes those calls of an emulator of which it takes all features, see `EngineForm`."""

    emulator: Emulator

    name: ClassVar[str]

    @property
    def parameters(self) -> KernelParameters:
        """What kernels need of the emulator."""
        return self.emulator.kernel_parameters

    def prepare(self, solid: Tensor, budget: Tensor | None) -> RolloutContext:
        """The context of a rollout; arguments as there."""
        return RolloutContext(solid, budget)

    def predict(self, particles: Particles, context: RolloutContext) -> Bundle:
        """The next m frames."""
        device = particles.position.device.type
        with _full_precision(device):
            start = self.rasterise(particles, context)
            seen = self.normalise(start, context)
        output = self.network(seen, context.noise)
        with _full_precision(device):
            flight = self.fly(start, output, context)
            if self.emulator.constraints.density_cap and not self.emulator.training:
                flight = self.spread(start, flight, context)
            return self.land(start, flight)

    def network(self, seen: Tensor, noise: Tensor | None) -> Tensor:
        """The network's output (B, m, C_out, *S), of its own precision and scale.

        Args:
            seen: (B, C_in, *S) the normalised grid state.
            noise: (B, Z, *S), if there is any.
        """
        emulator = self.emulator
        seen = seen if noise is None else torch.cat([seen, noise.to(seen.dtype)], dim=1)
        return emulator.runtime.fields(emulator.processor, seen, emulator.network_precision)

    def solids_ahead(self, particles: Particles) -> Tensor | None:
        """(B, m, *S) solid fraction at each frame, of obstacles that keep their velocity; None where none moves."""
        model, velocity = self.emulator, particles.obstacle_velocity
        if velocity is None or model.training or not (model.scene.obstacles and model.constraints.solids):
            return None
        at_frames = (
            dataclasses.replace(particles, obstacle=particles.obstacle + frame * velocity)
            for frame in range(1, model.frames + 1)
        )
        return torch.cat([model.solid(there) for there in at_frames], dim=1)

    @abstractmethod
    def rasterise(self, particles: Particles, context: RolloutContext) -> Start:
        """The particles in cells, and the grid state."""

    @abstractmethod
    def normalise(self, start: Start, context: RolloutContext) -> Tensor:
        """What the network sees, (B, C_in, *S), as `Emulator.normalise` of the grid state."""

    @abstractmethod
    def fly(self, start: Start, output: Tensor, context: RolloutContext) -> Flight[Values]:
        """The particles' way through the bundle, which obeys the constraints; in training the bounds alone."""

    @abstractmethod
    def spread(self, start: Start, flight: Flight[Values], context: RolloutContext) -> Flight[Values]:
        """The same with overfull cells at its end spread, evenly over its frames."""

    @abstractmethod
    def land(self, start: Start, flight: Flight[Values]) -> Bundle:
        """The bundle in domain length."""


@dataclass(frozen=True)
class EngineForm:
    """One form of an engine, for rollouts or for trainings.

    Args:
        name: Column in the documentation's tables of what runs where.
        title: For `Emulator.explain`, such as "Numba kernels".
        features: Those of `nmpm.emulator.engines.rules.MODELS` and `CALLS` that it takes. Torch's operations compute
            calls with any other one.
        make: Makes the engine of an emulator.
    """

    name: str
    title: str
    features: frozenset[str]
    make: Callable[[Emulator], Engine[Any, Any]]


def _full_precision(device: str) -> AbstractContextManager[object]:
    """A context without autocast; entering one where none is on would cost as much as a small operation."""
    return torch.autocast(device, enabled=False) if is_autocast(device) else nullcontext()


def is_autocast(device: str) -> bool:
    """Whether autocast is on for a type of device."""
    return torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
