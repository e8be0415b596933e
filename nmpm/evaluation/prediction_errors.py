"""Errors of a predicted scene by name, its energy, and the shape of settled material.

| name | what |
|---|---|
| mse@8, …, mse | squared position error up to a frame, and over all frames; length² |
| field | share of each material that lies in another cell, of 3 particle spacings; mean over evenly spaced frames |
| emd | earth mover's distance per material, mean over a few frames that are evenly spaced; length |
| kinetic | mean absolute error of the kinetic energy, over its mean |
| height | deviation of the mean height above the floor in the last frame, relative |
| crowding | deviation of the particles per occupied cell in the last frame, relative |
| crps | fair CRPS of the density in cells, of one rollout its absolute error; mean over evenly spaced frames |

Position errors barely notice a liquid that slowly loses its volume; height and crowding do.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nmpm.grid import counting_grid
from nmpm.metrics import check_emd, earth_mover_of_materials
from nmpm.metrics.ensembles import fair_crps, measure_quantities
from nmpm.metrics.quantities import energies, into_domain, measure_shape, volume_fractions
from nmpm.particles import Window
from nmpm.scene import Scene

REVISION = 4
"""Increased whenever the same prediction gets other errors."""

_MOST_GAIN = 0.05  # of the initial energy: a prediction that gains more is unstable
_FIELD_FRAMES = 50  # at which fields are compared


@dataclass(frozen=True)
class Measures:
    """Settings of `measure_errors`.

    Args:
        horizons: Frames up to which the MSE is reported, beside the full rollout.
        emd_frames: Evenly spaced frames at which the earth mover's distance is computed; 0 for none.
        emd_particles: Particles of a material, drawn at random, that it matches; all when left out.
        crps: Whether the fair CRPS of densities is measured, in which ensembles compete.
    """

    horizons: tuple[int, ...] = (8, 32, 100)
    emd_frames: int = 1
    emd_particles: int | None = None
    crps: bool = False

    def __post_init__(self) -> None:
        if self.emd_frames:
            check_emd()

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain data."""
        plain = dataclasses.asdict(self) | {"horizons": list(self.horizons), "revision": REVISION}
        return plain if self.crps else {name: value for name, value in plain.items() if name != "crps"}


def measure_errors(scene: Scene, window: Window, predicted: Tensor, measures: Measures) -> dict[str, float]:
    """Errors of a prediction (1, T, N, D) of the only scene of a window; all positions that count are finite.

    Of several members (M, T, N, D) `crps` is that of all, the others are those of the first.
    Where the data have only some of the model's frames, these count, and horizons are in frames of the data.
    Of particles that enter and leave, those that are present count, and energies and shapes are left out.
    """
    if window.observed is not None:
        window, predicted = window.at_observed(), predicted[:, window.observed_targets]
    crps = {"crps": density_crps(scene, window, predicted)} if measures.crps else {}
    predicted = predicted[:1]
    moving = window.mask[0]
    material = window.material[0, moving]
    volume = None if window.volume is None else window.volume[0, moving].double()
    there = None if window.present is None else window.present[0, 2:, moving]
    ours, theirs = predicted[0, :, moving].double(), window.target[0, :, moving].double()
    curve = squared_errors(window, predicted)
    errors = {"mse": _mean(curve)} | {f"mse@{h}": _mean(curve[:h]) for h in measures.horizons if h <= len(curve)}
    errors |= crps
    errors["field"] = field_error(scene, ours, theirs, material, there, volume)
    if measures.emd_frames:
        frames = _evenly_spaced(len(ours), measures.emd_frames)
        counts = None if there is None else there[frames]
        errors["emd"] = earth_mover_of_materials(
            ours[frames], theirs[frames], material, measures.emd_particles, counts, volume
        )
    if there is not None:
        return errors
    kinetic, truth = (energies(scene, *_path(window, positions))[0] for positions in (ours, theirs))
    errors["kinetic"] = float((kinetic - truth).abs().mean() / truth.mean().clamp(min=1e-300))
    if bool((window.gravity != 0).any()):
        grid, state = counting_grid(scene), window.initial
        last = (predicted[:, -1], window.target[:, -1])
        shape, right = (measure_shape(scene, grid, state, into_domain(scene, position)) for position in last)
        errors |= {name: abs(float(shape[name] / right[name]) - 1) for name in ("height", "crowding")}
    return errors


def squared_errors(window: Window, predicted: Tensor) -> Tensor:
    """Mean over particles and dimensions of the squared position error of each frame, (T,), in length².

    Of the particles that are present; NaN where none is.
    """
    moving = window.mask[0]
    squared = (predicted[0, :, moving].double() - window.target[0, :, moving].double()).square()
    if window.present is None:
        return squared.mean((1, 2))
    there = window.present[0, 2:, moving]
    return torch.where(there, squared.mean(2), 0.0).sum(1) / there.sum(1)


def field_error(
    scene: Scene,
    ours: Tensor,
    theirs: Tensor,
    material: Tensor,
    there: Tensor | None = None,
    volume: Tensor | None = None,
) -> float:
    """Share of the material that another prediction has in other cells, from 0 (the same field) to 1 (none in common).

    Σ |φ̂ − φ| / Σ (φ̂ + φ) over cells, with φ the linear volume fraction of each material. Unlike the position error it
    does not ask which particle is where, so that particles of other sizes can be compared, and mixing costs nothing.

    Args:
        scene: Gives domain and particle spacing.
        ours: (T, N, D) positions, as `theirs`; those outside of the domain count as `into_domain` moves them.
        theirs: (T, N, D).
        material: (N,) index into the scene's materials.
        there: (T, N) bool, which particles count in each frame; all when left out.
        volume: (N,) of each particle, in any unit; all the same when left out.
    """
    frames = _evenly_spaced(len(ours), _FIELD_FRAMES)
    sizes = torch.ones(len(material), dtype=ours.dtype) if volume is None else volume
    sizes = sizes.expand(len(frames), -1)
    if there is not None:
        sizes = sizes * there[frames]
        ours, theirs = (
            path.where(there.unsqueeze(-1), path.new_tensor(scene.domain).mean(1)) for path in (ours, theirs)
        )
    first, second = (
        volume_fractions(scene, counting_grid(scene), path[frames], material, sizes) for path in (ours, theirs)
    )
    wrong, total = (each.flatten(1).sum(1) for each in ((first - second).abs(), first + second))
    return _mean(wrong / total)


def density_crps(scene: Scene, window: Window, members: Tensor) -> float:
    """Mean over cells, materials and evenly spaced frames of the fair CRPS of the density of members (M, T, N, D)."""
    scores = []
    for frame in _evenly_spaced(members.shape[1], _FIELD_FRAMES).tolist():
        recorded, predicted = window.recorded[:, frame + 2], members[:, frame]
        if window.present is not None:
            predicted = predicted.where(window.present[:, frame + 2].unsqueeze(-1), torch.nan)
        truth, ensemble = (
            measure_quantities(scene, window, position, position)["density"] for position in (recorded, predicted)
        )
        scores.append(float(fair_crps(ensemble, truth[0]).mean()))
    return float(np.mean(scores))


def _mean(values: Tensor) -> float:
    """The mean of (T,) values but those that are NaN, of frames without a particle that counts."""
    return float(values[~values.isnan()].mean())


def _evenly_spaced(frames: int, count: int) -> NDArray[np.int64]:
    """Indices of `count` frames, or of all where there are fewer; the last is among them."""
    return np.unique(np.linspace(0, frames - 1, count + 1).round().astype(np.int64)[1:])


def _path(window: Window, positions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Positions (T + 2, N, D) from the window's first two frames on, materials, gravity, volumes of its particles."""
    moving = window.mask[0]
    start = window.frames[0, :2, moving].double()
    volume = None if window.volume is None else window.volume[0, moving].double()
    return torch.cat([start, positions.double()]), window.material[0, moving], window.gravity[0].double(), volume


def recorded_energy_gain(scene: Scene, window: Window, predicted: Tensor) -> float:
    """`energy_gain` of a prediction (1, T, N, D) of the only scene of a window, from its first two frames on.

    It is 0 where energy may come in, by obstacles that move, open axes, or particles that enter.
    """
    if window.present is not None or not scene.is_closed:
        return 0.0
    return energy_gain(scene, *_path(window, predicted[0, :, window.mask[0]]))


def energy_gain(scene: Scene, path: Tensor, material: Tensor, gravity: Tensor, volume: Tensor | None = None) -> float:
    """Most energy in a path beyond that between its first two frames, as a share of that; 0 where that has none.

    Arguments as of `energies`.
    """
    total = energies(scene, path.double(), material, gravity.double(), volume)[1]
    initial = float(total[0])
    return float(total.max() / initial - 1) if initial > 0 else 0.0


def instability(gain: float) -> str:
    """Why a prediction that gains this share of the initial energy is unstable; empty if it is not."""
    return f"gains {gain:.0%} of energy" if gain > _MOST_GAIN else ""
