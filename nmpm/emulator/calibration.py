"""Normalisation statistics of an emulator: from a sample of its training data, and what they say of the inputs."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm._support.collectives import all_gather, rank_and_world_size
from nmpm.emulator.engines.torch.engine import TorchEngine
from nmpm.emulator.fields import calibrate_fields, true_rates
from nmpm.emulator.model import UNLIMITED, Emulator
from nmpm.emulator.prescribed import start_of
from nmpm.emulator.rasterise import volume_fraction
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.transfer import Linear

_MARGIN = 0.5
"""Inputs are clipped to the sampled range, widened by this fraction of it on either side."""

_FULL = 0.995
"""Share of the occupied cells that are not fuller than the density cap."""


@dataclass(frozen=True)
class _Inputs:
    """Statistics (C,) of a sample's grid states, and their number of cells."""

    cells: int
    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor


@dataclass(frozen=True)
class _Unknowns:
    """Mean square (m, V) over a material's particles of what the network has to predict: velocities, or rates."""

    particles: int
    square: Tensor


@torch.no_grad()
def calibrate(emulator: Emulator, windows: Sequence[Window]) -> None:
    """Set the normalisation statistics from training windows of at least m + 2 frames, on any device.

    Inputs get mean and standard deviation per channel over all cells, and the limits to which they are clipped; outputs
    the root mean square, per frame of the bundle and component, of the true velocities without the decoder's known
    part, and of the evolving fields' changes. Fields get mean and standard deviation. A material without particles in
    the windows gets the other materials' scales. Where several processes train together, all of them call this, each
    with windows of its own, and get the statistics of all.

    Raises ValueError if there is no window or one is too short; warns of materials without particles in the windows.
    """
    if not windows or min(window.target.shape[1] for window in windows) < emulator.frames:
        raise ValueError(f"Calibration needs windows of at least {emulator.frames + 2} frames.")
    windows = [window.to(emulator.device) for window in windows]
    calibrate_fields(emulator.field_scales, windows, emulator.scene.fields)
    inputs = _combine(all_gather(_inputs(emulator, windows)))
    materials = list(zip(*all_gather(_unknowns(emulator, windows)), strict=True))
    empty = [not any(part.particles for part in parts) for parts in materials[: len(emulator.scene.materials)]]
    absent = [] if all(empty) else [index for index, is_empty in enumerate(empty) if is_empty]
    if absent:
        warnings.warn(
            f"The windows that the model is calibrated on have no particles of"
            f" {', '.join(emulator.scene.materials[index] for index in absent)}, which get the other materials' scales:"
            " if they move very differently, shuffle the training trajectories, or calibrate on more.",
            stacklevel=3,
        )
    emulator.input_mean.copy_(_borrowed(inputs.mean, emulator.scene, absent).reshape_as(emulator.input_mean))
    emulator.input_std.copy_(_nonzero(_borrowed(inputs.std, emulator.scene, absent)).reshape_as(emulator.input_std))
    low, high = _limits(inputs)
    emulator.input_low.copy_(low.reshape_as(emulator.input_low))
    emulator.input_high.copy_(high.reshape_as(emulator.input_high))
    scale = torch.cat([_root_mean_square(parts) for parts in _substituted(materials, emulator.scene)], dim=-1)
    emulator.output_scale.copy_(_nonzero(scale).reshape_as(emulator.output_scale))
    emulator.calibrated.fill_(True)


@torch.no_grad()
def unread_inputs(emulator: Emulator) -> list[int]:
    """Indices of the input channels that the network does not read, as its weights for them are all 0: added ones."""
    layers = emulator.processor.channel_layers
    if layers is None:
        return []
    count = len(emulator.scene.input_channels)
    weight: Tensor = emulator.processor.get_submodule(layers.first).weight  # type: ignore[assignment]  # (parametrised, too)
    reads = weight[:, : count * layers.cells].unflatten(1, (count, layers.cells)).movedim(1, 0).flatten(1)
    return [index for index, silent in enumerate((reads == 0).all(1).tolist()) if silent]


@torch.no_grad()
def calibrate_unread(emulator: Emulator, windows: Sequence[Window]) -> None:
    """Set the statistics of inputs that the network does not read yet, from training windows; predictions stay.

    Their mean is 0, so that scenes that have nothing there still look as before once the network reads them; what does
    not occur in the windows keeps its statistics. Where several processes train together, all of them call this.
    """
    windows, names = [window.to(emulator.device) for window in windows], emulator.scene.input_channels
    unread = unread_inputs(emulator)
    read = {name.rpartition(".")[2] for index, name in enumerate(names) if index not in unread}
    calibrate_fields(emulator.field_scales, windows, [name for name in emulator.scene.fields if name not in read])
    inputs = _combine(all_gather(_inputs(emulator, windows)))
    low, high = _limits(inputs)
    size = (inputs.mean.square() + inputs.std.square()).sqrt()
    for index in unread:
        if size[index] > 1e-12:
            emulator.input_mean[index], emulator.input_std[index] = 0.0, size[index]
            emulator.input_low[index], emulator.input_high[index] = low[index], high[index]


def _limits(inputs: _Inputs) -> tuple[Tensor, Tensor]:
    """(C,) the limits to which inputs are clipped."""
    # A channel that never varies in the sample may well do so elsewhere.
    spread = inputs.high - inputs.low
    margin = torch.where(spread > 1e-12, _MARGIN * spread, UNLIMITED)
    return inputs.low - margin, inputs.high + margin


@torch.no_grad()
def density_cap(emulator: Emulator, windows: Sequence[Window]) -> float:
    """The volume fraction that the fullest 0.5% of the occupied cells exceed, for `Constraints.density_cap`.

    Cells that are half solid or less than half full do not count. Windows are of training data, drawn from whole
    trajectories, as crowding grows while material settles.

    Raises ValueError if no cell is half full.
    """
    fractions = []
    for window in (window.to(emulator.device) for window in windows):
        start, grid = window.initial, emulator.grid
        taken = emulator.solid(start)
        room = 1 - (taken if taken.shape[1] else emulator.walls)
        volume, cells = window.volume_at(-1), grid.to_cells(window.target[:, -1])
        full = volume_fraction(emulator.scene, grid, Linear(), volume, cells)
        fractions.append((full / room.clamp(min=0.5))[(full > 0.5) & (room > 0.5)])
    filled = torch.cat(fractions).sort().values
    if not len(filled):
        raise ValueError("No cell of the windows is half full: the density cap cannot be measured.")
    return float(filled[min(len(filled) - 1, int(_FULL * len(filled)))])


def _inputs(emulator: Emulator, windows: Sequence[Window]) -> _Inputs:
    starts = [start_of(window, emulator.frames) for window in windows]
    state = torch.cat([TorchEngine(emulator).grid_state(start, emulator.solid(start))[-1] for start in starts])
    axes = (0, *range(2, state.dim()))
    cells = state.numel() // state.shape[1]
    figures = (state.mean(axes), state.std(axes), state.amin(axes), state.amax(axes))
    return _Inputs(cells, *map(_shareable, figures))


def _shareable(values: Tensor) -> Tensor:
    """The values on the CPU, where several processes with devices of their own combine them; else where they are."""
    return values.cpu() if rank_and_world_size()[1] > 1 else values


def _combine(parts: Sequence[_Inputs]) -> _Inputs:
    """The statistics of several samples together."""
    if len(parts) == 1:
        return parts[0]
    cells = sum(part.cells for part in parts)
    mean = torch.stack([part.mean.double() * (part.cells / cells) for part in parts]).sum(0)
    squares = [part.std.double().square() * (part.cells - 1) for part in parts]
    squares += [(part.mean - mean).square() * part.cells for part in parts]
    return _Inputs(
        cells,
        mean.to(parts[0].mean),
        (torch.stack(squares).sum(0) / (cells - 1)).sqrt().to(parts[0].std),
        torch.stack([part.low for part in parts]).amin(0),
        torch.stack([part.high for part in parts]).amax(0),
    )


def _unknowns(emulator: Emulator, windows: Sequence[Window]) -> list[_Unknowns]:
    """For each material the part of the velocity that the network has to predict, then of each the fields' rates."""
    unknown = [[_unknown_velocity(emulator, window) for window in windows]]
    if emulator.scene.evolving:
        unknown.append([true_rates(emulator.field_scales, window, emulator.frames) for window in windows])
    result = []
    for parts in unknown:  # (B, m, N, V) in each window
        for index in range(len(emulator.scene.materials)):
            of_material = [_stay(window, emulator.frames) & (window.material == index) for window in windows]
            values = torch.cat([part.transpose(1, 2)[real] for part, real in zip(parts, of_material, strict=True)])
            result.append(_Unknowns(len(values), _shareable(values.square().mean(0))))
    return result


def _stay(window: Window, frames: int) -> Tensor:
    """(B, N) bool: the particles that are there at the start and in the first frames to predict."""
    return window.mask if window.present is None else window.mask & window.present[:, : frames + 2].all(1)


def _borrowed(values: Tensor, scene: Scene, absent: Sequence[int]) -> Tensor:
    """Figures (C,) of the input channels, those of absent materials replaced by the mean of the others'."""
    if not absent:
        return values
    values, count = values.clone(), len(scene.materials)
    present = [index for index in range(count) if index not in absent]
    fields = len(scene.particle_fields)
    first_field = len(values) - len(scene.parameters) - count * fields
    for first, size in ((0, scene.dim), (count * scene.dim, 1), (first_field, fields)):
        rows = values[first : first + count * size].view(count, size)
        rows[absent] = rows[present].mean(0)
    return values


def _substituted(materials: Sequence[Sequence[_Unknowns]], scene: Scene) -> list[Sequence[_Unknowns]]:
    """Each material's parts, of velocities and then of fields; those of all materials for one without particles."""
    count = len(scene.materials)
    groups = [materials[first : first + count] for first in range(0, len(materials), count)]
    return [
        parts if any(part.particles for part in parts) else [part for others in group for part in others]
        for group in groups
        for parts in group
    ]


def _root_mean_square(parts: Sequence[_Unknowns]) -> Tensor:
    """(m, D) over all particles of the parts; 1 where there is none."""
    some = [part for part in parts if part.particles] or parts[:1]
    if len(some) == 1:
        return some[0].square.sqrt().nan_to_num(1.0)
    total = sum(part.particles for part in some)
    square = torch.stack([part.square.double() * (part.particles / total) for part in some]).sum(0)
    return square.sqrt().to(some[0].square)


def _unknown_velocity(emulator: Emulator, window: Window) -> Tensor:
    """(B, m, N, D) true velocities less what the decoder knows, in cells per frame."""
    decoder, steps = emulator.decoder, window.frames[:, 1:].diff(dim=1)[:, : emulator.frames]
    steps = emulator.grid.to_cell_displacement(steps, emulator.precision)
    _, velocity, gravity = emulator.in_cells(window.initial)
    carried = decoder.carried_velocity(velocity, velocity)
    before = [carried, *steps.unbind(1)]
    known = [decoder.known_velocity(carried, before[i - 1], gravity, i) for i in range(1, emulator.frames + 1)]
    return steps - torch.stack(known, dim=1)


def _nonzero(scale: Tensor) -> Tensor:
    """Scales that can be divided by: a channel that never varies is left as it is."""
    return torch.where(scale > 1e-12, scale, torch.ones_like(scale))


def calibrated_range(emulator: Emulator, prefix: str) -> tuple[Tensor, Tensor]:
    """Lower and upper limits (D,) of the input channels of that prefix, in length/s; infinite where unlimited."""
    scale = torch.tensor(emulator.grid.spacing, dtype=torch.float64) / emulator.scene.dt
    low, high = (channel_values(emulator, limit, prefix) for limit in (emulator.input_low, emulator.input_high))
    low = torch.where(low <= -UNLIMITED / 2, -torch.inf, low)
    return low * scale, torch.where(high >= UNLIMITED / 2, torch.inf, high) * scale


def gravity_range(emulator: Emulator) -> tuple[Tensor, Tensor]:
    """Lower and upper limits (D,) of gravity, in length/s², of a model whose scenes differ in it."""
    low, high = calibrated_range(emulator, "gravity_")
    return low / emulator.scene.dt, high / emulator.scene.dt


def usual_gravity(emulator: Emulator) -> Tensor:
    """The gravity (D,), in length/s², to show a model with whose scenes differ in it.

    The scene's, if it states one; else downwards along the second axis, as strong as in the root mean square of the
    training, within the calibrated range.
    """
    if emulator.scene.gravity is not None:
        return torch.tensor(emulator.scene.gravity, dtype=torch.float64)
    scale = torch.tensor(emulator.grid.spacing, dtype=torch.float64) / emulator.scene.dt**2
    mean, std = (
        channel_values(emulator, each, "gravity_") * scale for each in (emulator.input_mean, emulator.input_std)
    )
    down = torch.zeros_like(mean)
    down[1] = -(mean.square() + std.square()).sum().sqrt()
    return torch.clamp(down, *gravity_range(emulator))


def with_usual_gravity(emulator: Emulator, state: Particles) -> Particles:
    """A made-up state with the usual gravity where the emulator's scenes differ in it; elsewhere the state itself."""
    if not emulator.scene.gravity_varies:
        return state
    pull = (usual_gravity(emulator) * emulator.scene.dt**2).to(state.gravity)
    return dataclasses.replace(state, gravity=pull.expand(state.gravity.shape))


def channel_values(emulator: Emulator, statistic: Tensor, prefix: str) -> Tensor:
    """Of a statistic of the input channels, the values (D,) of those of that prefix, in cells, on the CPU."""
    channels = [i for i, name in enumerate(emulator.scene.input_channels) if name.startswith(prefix)]
    return statistic[channels].flatten().cpu().double()
