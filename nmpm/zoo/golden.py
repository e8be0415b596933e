"""A short rollout stored on an entry's card, which detects changes of weights, statistics or code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.data.initial_states import thrown_blocks
from nmpm.emulator import Emulator, rollout
from nmpm.errors import ZooError
from nmpm.zoo.pretrained import Pretrained

FRAMES = 32
COUNT = 300
PROBES = 8
"""Number of particles whose last positions are stored."""
SEEDS = 8
"""Number of scenes to choose from."""
TOLERANCE = 1e-3
"""Largest distance from a stated position, in cells: other processors and versions of torch round differently."""


def golden_rollout(emulator: Emulator) -> dict[str, Any]:
    """The last positions of some particles in a rollout of a thrown block, with what determines it.

    Of the first scenes it is the one that deforms the block most: what flies freely would hardly show that a network's
    output has changed.
    """
    count = Pretrained(emulator, {}).fitting_count(COUNT, blocks=1)
    paths = [_positions(emulator, seed, count, FRAMES) for seed in range(SEEDS)]
    seed = max(range(SEEDS), key=lambda seed: _deformation(emulator, seed, count, paths[seed]))
    return {"seed": seed, "count": count, "frames": FRAMES, "position": paths[seed].tolist()}


def golden_distance(model: Pretrained, golden: Mapping[str, Any]) -> float:
    """Largest distance of a model's rollout from a stated one, in cells.

    Raises:
        ZooError: if what is stated is not such a rollout.
    """
    try:
        seed, count, frames = (int(golden[key]) for key in ("seed", "count", "frames"))
        stated = torch.tensor(golden["position"], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        reason = one_line(repr(error))
        raise ZooError(f"{model.name}: the golden rollout of its card cannot be read: {reason}.") from error
    if stated.shape != (PROBES, model.scene.dim) or seed < 0 or count < 1 or not 1 <= frames <= FRAMES:
        raise ZooError(
            f"{model.name}: the golden rollout of its card should have a seed, a count, up to {FRAMES} frames and"
            f" {PROBES} positions in {model.scene.dim} dimensions."
        )
    spacing = torch.tensor(model.emulator.grid.spacing, dtype=torch.float64)
    try:
        found = _positions(model.emulator, seed, count, frames)
    except ValueError as error:  # such as more particles than fit
        raise ZooError(f"{model.name}: the golden rollout of its card cannot be repeated: {error}") from error
    return float(((found - stated) / spacing).norm(dim=-1).max())


def _positions(emulator: Emulator, seed: int, count: int, frames: int) -> Tensor:
    """(PROBES, D) positions, rounded to 1e-7."""
    state = thrown_blocks(emulator.scene, count, seed=seed)  # weightless where gravity varies, as cards state it
    last = rollout(emulator, state.to(emulator.device), frames)[0, -1].double().cpu()
    return _probes(last).mul(1e7).round().div(1e7)


def _deformation(emulator: Emulator, seed: int, count: int, last: Tensor) -> float:
    """How far the displacements of the probes to their last positions (PROBES, D) differ from each other."""
    first = thrown_blocks(emulator.scene, count, seed=seed).position[0].double()
    return float((last - _probes(first)).std(0).norm())


def _probes(position: Tensor) -> Tensor:
    """Some of the particles (N, D)."""
    return position[torch.linspace(0, len(position) - 1, PROBES).long()]
