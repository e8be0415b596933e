"""Errors of one predicted scene, by name.

| name | what |
|---|---|
| mse@8, …, mse | squared position error up to a frame, and over all frames; length² |
| field | share of each material that lies in another cell, of 3 particle spacings; mean over evenly spaced frames |
| emd | exact earth mover's distance per material, mean over a few frames that are evenly spaced; length |
| kinetic | mean absolute error of the kinetic energy, over its mean |
| height | deviation of the mean height above the floor in the last frame, relative |
| crowding | deviation of the particles per occupied cell in the last frame, relative |

`gain` is the energy gained beyond the initial one, as a share of it: no error, but a mark of instability. Where a
choice simulates other particles than the recorded ones it is that of its own, see `choice.Prediction`: recorded ones
that follow them weigh them unevenly, and seem to gain energy that no simulated particle has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nmpm.evaluation.shape import measure_shape
from nmpm.grid import Grid
from nmpm.metrics import earth_mover_of_materials
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.transfer import Linear

REVISION = 3
"""Increased whenever the same prediction gets other errors."""

GAIN = "gain"
_MOST_GAIN = 0.05
"""A prediction that gains more energy than this share of the initial one is unstable."""

_CELL = 3.0  # particle spacings: side of the cells in which particles are counted
_FIELD_FRAMES = 50  # at which fields are compared


@dataclass(frozen=True)
class Measures:
    """What is measured of a prediction.

    Args:
        horizons: Frames at which the MSE is reported, beside the full rollout.
        emd_frames: Evenly spaced frames at which the earth mover's distance is computed, the last among them; 0 for
            none, as each takes half a second for 2,000 particles.
    """

    horizons: tuple[int, ...] = (8, 32, 100)
    emd_frames: int = 1

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain data."""
        return {"horizons": list(self.horizons), "emd_frames": self.emd_frames, "revision": REVISION}


def measure_errors(scene: Scene, window: Window, predicted: Tensor, measures: Measures) -> dict[str, float]:
    """Errors of a prediction (1, T, N, D) of the only scene of a window; all positions are finite."""
    moving = window.mask[0]
    ours, theirs = predicted[0, :, moving].double(), window.target[0, :, moving].double()
    found = _squared(ours, theirs, measures.horizons)
    found["field"] = field_error(scene, ours, theirs, window.material[0, moving])
    if measures.emd_frames:
        found["emd"] = _earth_mover(ours, theirs, window.material[0, moving], measures.emd_frames)
    found |= _energies(scene, window, ours, theirs)
    if bool((window.gravity != 0).any()):
        found |= _shapes(scene, window.initial, predicted[:, -1], window.target[:, -1])
    return found


def _squared(ours: Tensor, theirs: Tensor, horizons: Sequence[int]) -> dict[str, float]:
    curve = (ours - theirs).square().mean((1, 2))
    at = {f"mse@{h}": float(curve[:h].mean()) for h in horizons if h <= len(curve)}
    return at | {"mse": float(curve.mean())}


def field_error(scene: Scene, ours: Tensor, theirs: Tensor, material: Tensor) -> float:
    """Share of the material that another prediction has in other cells, from 0 (the same field) to 1 (none in common).

    Σ |φ̂ − φ| / Σ (φ̂ + φ) over cells, with φ the linear volume fraction of each material. Unlike the position error it
    does not ask which particle is where, so that particles of other sizes can be compared, and mixing costs nothing.

    Args:
        scene: Gives domain and particle spacing.
        ours: (T, N, D) positions; those outside of the domain count as `into_domain` moves them.
        theirs: (T, N, D) likewise.
        material: (N,) index into the scene's materials.
    """
    chosen = _evenly_spaced(len(ours), _FIELD_FRAMES)
    grid, kinds = _counting_grid(scene), torch.nn.functional.one_hot(material, len(scene.materials)).to(ours.dtype)
    values = kinds.expand(len(chosen), -1, -1)
    first, second = (
        Linear().p2g(values, grid.to_cells(into_domain(scene, path[chosen]), path.dtype), grid)
        for path in (ours, theirs)
    )
    wrong = (first - second).abs().flatten(1).sum(1)
    return float((wrong / (first + second).flatten(1).sum(1)).mean())


def into_domain(scene: Scene, position: Tensor) -> Tensor:
    """Positions (..., D) moved into the domain: by whole periods, and to the border at walls."""
    columns = []
    for along, (low, high), periodic in zip(position.unbind(-1), scene.domain, scene.periodic, strict=True):
        columns.append(low + (along - low).remainder(high - low) if periodic else along.clamp(low, high))
    return torch.stack(columns, dim=-1)


def _earth_mover(ours: Tensor, theirs: Tensor, material: Tensor, count: int) -> float:
    frames = _evenly_spaced(len(ours), count)
    return earth_mover_of_materials(ours[frames], theirs[frames], material)


def _evenly_spaced(frames: int, count: int) -> NDArray[np.int64]:
    """Indices of `count` frames, or of all where there are fewer; the last is among them."""
    return np.unique(np.linspace(0, frames - 1, count + 1).round().astype(np.int64)[1:])


def _energies(scene: Scene, window: Window, ours: Tensor, theirs: Tensor) -> dict[str, float]:
    moving = window.mask[0]
    material, gravity = window.material[0, moving], window.gravity[0].double()
    start = window.frames[0, :2, moving].double()
    kinetic, total = _energy(scene, torch.cat([start, ours]), material, gravity)
    truth, _ = _energy(scene, torch.cat([start, theirs]), material, gravity)
    found = {"kinetic": float((kinetic - truth).abs().mean() / truth.mean().clamp(min=1e-300))}
    return found | {GAIN: _gain(total)}


def gain_failure(gain: float) -> str:
    """Why a prediction that gains this share of the initial energy is unstable; empty if it is not."""
    return f"gains {gain:.0%} of energy" if gain > _MOST_GAIN else ""


def energy_gain(scene: Scene, path: Tensor, material: Tensor, gravity: Tensor) -> float:
    """Most energy in a path beyond that between its first two frames, as a share of that; 0 where that has none.

    Args:
        scene: Gives bounds and densities.
        path: (T, N, D) positions of all moving particles, which have the same volume.
        material: (N,) index into the scene's materials.
        gravity: (D,) in length per frame squared.
    """
    return _gain(_energy(scene, path.double(), material, gravity.double())[1])


def _gain(total: Tensor) -> float:
    initial = float(total[0])
    return float(total.max() / initial - 1) if initial > 0 else 0.0


def _energy(scene: Scene, path: Tensor, material: Tensor, gravity: Tensor) -> tuple[Tensor, Tensor]:
    """Kinetic, and kinetic and potential energy per mass between frames, (T - 1,), of a path (T, N, D)."""
    mass = torch.tensor(scene.densities or (1.0,) * len(scene.materials), dtype=torch.float64)[material]
    share = mass / mass.sum()
    steps = path.diff(dim=0)
    kinetic = (steps.square().sum(-1) * share).sum(-1) / 2
    middle = (path[1:] + path[:-1]) / 2
    low, high = torch.tensor(scene.bounds, dtype=torch.float64).T
    floor = torch.where(gravity < 0, low, high)
    return kinetic, kinetic - (((middle - floor) @ gravity) * share).sum(-1)


def _shapes(scene: Scene, state: Particles, ours: Tensor, theirs: Tensor) -> dict[str, float]:
    grid = _counting_grid(scene)
    shapes = [measure_shape(scene, grid, state, into_domain(scene, position)) for position in (ours, theirs)]
    relative = shapes[0].relative_to(shapes[1])
    return {name: abs(relative[name] - 1) for name in ("height", "crowding")}


def _counting_grid(scene: Scene) -> Grid:
    longest = max(high - low for low, high in scene.domain)
    return Grid.of(scene, max(1, round(longest / (_CELL * scene.particle_spacing))))
