"""One call of an emulator: p2g, network, and m times g2p and advection; the parts around the network are `Steps`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.departure import Departure
from nmpm.emulator.outputs import with_output
from nmpm.emulator.windows.reads import check_reads
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.emulator.steps import TensorSteps


@dataclass(frozen=True)
class Flight:
    """What the network's output has led to.

    Args:
        start: What the bundle starts from.
        path: (B, m, N, D) positions in cells.
        evolved: Evolving fields along it, (B, m, N) by name.
    """

    start: Departure
    path: Tensor
    evolved: Mapping[str, Tensor]


def predict_bundle(emulator: Emulator, steps: TensorSteps, particles: Particles, context: RolloutContext) -> Bundle:
    """The next m frames, operation by operation; only the network is left to the runtime.

    Args:
        emulator: Gives network, statistics and units.
        steps: What is computed around the network.
        particles: The state to start from.
        context: Of the rollout.
    """
    device = particles.position.device.type
    with _full_precision(device):
        cells, velocity, gravity, state = steps.rasterise(particles, context.solid)
        normalised = emulator.normalise(state)
        if emulator.training and emulator.recipe.grid_noise > 0:
            normalised = normalised + emulator.recipe.grid_noise * normal_like(normalised)

    def fly(output: Tensor, readable: Tensor | None) -> Flight:
        with _full_precision(device):
            flows = _flows(emulator)
            own, scale = output[:, :, :flows], emulator.output_scale[:, :flows]
            start = Departure(cells, velocity, gravity, particles.material, particles.mask, state, own, scale, readable)
            path = steps.path(start, context)
            evolving = emulator.scene.evolving
            return Flight(start, path, _evolve_fields(emulator, particles, start, path, output) if evolving else {})

    flight = with_output(emulator, state, normalised, context, fly)
    with _full_precision(device):
        return _land(emulator, steps, flight, context, particles.position.dtype)


def _land(
    emulator: Emulator, steps: TensorSteps, flight: Flight, context: RolloutContext, precision: torch.dtype
) -> Bundle:
    start, path = flight.start, flight.path
    step = path[:, -1] - (path[:, -2] if emulator.frames > 1 else start.cells)
    if emulator.constraints.density_cap and not emulator.training:
        # Spreading is no motion of the material: the velocity is that of the path without it.
        path = steps.uncrowded(start, path, context)
    velocity = emulator.grid.to_displacement(step.to(precision))
    return Bundle(emulator.grid.to_length(path.to(precision)), velocity, flight.evolved)


def _evolve_fields(
    emulator: Emulator, particles: Particles, start: Departure, path: Tensor, output: Tensor
) -> Mapping[str, Tensor]:
    """The evolving fields along a path (B, m, N, D) in cells, (B, m, N) by name."""
    if start.readable is not None:
        check_reads(start.cells, path, start.mask, start.readable, emulator.grid)
    flows = _flows(emulator)
    places = torch.cat([start.cells.unsqueeze(1), path[:, :-1]], dim=1)
    rates = output[:, :, flows:].to(emulator.precision) * emulator.output_scale[:, flows:]
    gather = partial(emulator.advection.gather, material=particles.material)
    return emulator.field_scales.evolve(particles, places, rates, gather)


def _flows(emulator: Emulator) -> int:
    """Number of the output channels that are velocities."""
    return len(emulator.scene.materials) * emulator.scene.dim


def _full_precision(device: str) -> AbstractContextManager[object]:
    """A context without autocast; entering one where none is on would cost as much as a small operation."""
    on = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    return torch.autocast(device, enabled=False) if on else nullcontext()
