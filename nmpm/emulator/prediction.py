"""One call of an emulator: p2g, network, and m times g2p and advection; the parts around the network are `Steps`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nmpm._support.collectives import normal_like
from nmpm.emulator.bundle import Bundle, RolloutContext
from nmpm.emulator.departure import BundleStart
from nmpm.particles import Particles

if TYPE_CHECKING:
    from nmpm.emulator.model import Emulator
    from nmpm.emulator.steps import TensorSteps


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

    output = emulator.runtime.fields(emulator.processor, normalised, emulator.network_precision)
    with _full_precision(device):
        velocities = len(emulator.scene.materials) * emulator.scene.dim  # channels of the output; then rates of fields
        predicted, scale = output[:, :, :velocities], emulator.output_scale[:, :velocities]
        start = BundleStart(cells, velocity, gravity, particles.material, particles.mask, state, predicted, scale)
        path = steps.path(start, context)
        fields: Mapping[str, Tensor] = {}
        if emulator.scene.evolving:
            rates = output[:, :, velocities:].to(emulator.precision) * emulator.output_scale[:, velocities:]
            before = torch.cat([cells.unsqueeze(1), path[:, :-1]], dim=1)
            gather = partial(emulator.advection.gather, material=particles.material)
            fields = emulator.field_scales.evolve(particles, before, rates, gather)
        step = path[:, -1] - (path[:, -2] if emulator.frames > 1 else cells)
        if emulator.constraints.density_cap and not emulator.training:
            # Spreading is no motion of the material: the velocity is that of the path without it.
            path = steps.uncrowded(start, path, context)
        precision = particles.position.dtype
        last_velocity = emulator.grid.to_displacement(step.to(precision))
        return Bundle(emulator.grid.to_length(path.to(precision)), last_velocity, fields)


def _full_precision(device: str) -> AbstractContextManager[object]:
    """A context without autocast; entering one where none is on would cost as much as a small operation."""
    on = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    return torch.autocast(device, enabled=False) if on else nullcontext()
