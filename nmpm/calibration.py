"""Normalisation statistics of an emulator, from a sample of the data that it will be trained on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.emulator import UNLIMITED, Emulator
from nmpm.particles import Window
from nmpm.rasterise import grid_state

_LEEWAY = 0.5
"""Of the range seen, on either side: what the network is shown beyond it, the sample being only a sample."""


@torch.no_grad()
def calibrate(emulator: Emulator, windows: Sequence[Window]) -> None:
    """Set the normalisation statistics from training windows of at least m + 2 frames.

    Inputs get mean and standard deviation per channel over all cells, and the limits beyond which the network is shown
    the limit; outputs the root mean square of what is left of the true velocities once the decoder's known part is
    taken out, per frame of the bundle and component.

    Raises:
        ValueError: if there is no window or one is too short.
    """
    if not windows or min(window.target.shape[1] for window in windows) < emulator.frames:
        raise ValueError(f"Calibration needs windows of at least {emulator.frames + 2} frames.")
    state = torch.cat([_state(emulator, window) for window in windows])
    axes = (0, *range(2, state.dim()))
    emulator.input_mean.copy_(state.mean(axes).reshape_as(emulator.input_mean))
    emulator.input_std.copy_(_nonzero(state.std(axes)).reshape_as(emulator.input_std))
    low, high = state.amin(axes), state.amax(axes)
    # A channel that never varies in the sample may well do so elsewhere.
    leeway = torch.where(high - low > 1e-12, _LEEWAY * (high - low), UNLIMITED)
    emulator.input_low.copy_((low - leeway).reshape_as(emulator.input_low))
    emulator.input_high.copy_((high + leeway).reshape_as(emulator.input_high))
    emulator.output_scale.copy_(_unknown_scale(emulator, windows).reshape_as(emulator.output_scale))
    emulator.calibrated.fill_(True)


def _state(emulator: Emulator, window: Window) -> Tensor:
    start, grid = window.initial, emulator.grid
    cells, velocity = grid.to_cells(start.position), grid.to_cell_displacement(start.velocity)
    return grid_state(emulator.scene, grid, emulator.transfer, start, cells, velocity, emulator.solid(start))


def _unknown_scale(emulator: Emulator, windows: Sequence[Window]) -> Tensor:
    """(m, C_out): root mean square of the part of the velocity that the network has to give."""
    unknown = [_unknown(emulator, window) for window in windows]
    scales = []
    for index in range(len(emulator.scene.materials)):
        chosen = [window.mask & (window.material == index) for window in windows]
        values = torch.cat([part.transpose(1, 2)[of] for part, of in zip(unknown, chosen, strict=True)])
        scales.append(values.square().mean(0).sqrt().nan_to_num(1.0))
    return _nonzero(torch.cat(scales, dim=-1))


def _unknown(emulator: Emulator, window: Window) -> Tensor:
    """(B, m, N, D) true velocities less what the decoder knows, in cells per frame."""
    grid, decoder = emulator.grid, emulator.decoder
    steps = grid.to_cell_displacement(window.frames[:, 1:].diff(dim=1))[:, : emulator.frames]
    velocity = grid.to_cell_displacement(window.initial.velocity)
    gravity = grid.to_cell_displacement(window.gravity).unsqueeze(1)
    carried = decoder.carried(velocity, velocity)
    before = [carried, *steps.unbind(1)]
    known = [decoder.known(carried, before[i - 1], gravity, i) for i in range(1, emulator.frames + 1)]
    return steps - torch.stack(known, dim=1)


def _nonzero(scale: Tensor) -> Tensor:
    """Scales that can be divided by: a channel that never varies is left as it is."""
    return torch.where(scale > 1e-12, scale, torch.ones_like(scale))
