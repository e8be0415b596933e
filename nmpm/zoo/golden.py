"""A short rollout stored on an entry's card, which detects changes of weights, statistics or code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nmpm.emulator import Emulator, rollout
from nmpm.zoo.pretrained import Pretrained

FRAMES = 32
COUNT = 300
PROBES = 8
"""Number of particles whose last positions are stored."""
TOLERANCE = 1e-3
"""Largest distance from a stated position, in cells: other processors and versions of torch round differently."""


def golden_rollout(emulator: Emulator) -> dict[str, Any]:
    """The last positions of some particles in a rollout of thrown blocks, with what determines it."""
    count = Pretrained(emulator, {}).fitting_count(COUNT)
    return {"seed": 0, "count": count, "frames": FRAMES, "position": _positions(emulator, 0, count, FRAMES).tolist()}


def golden_distance(model: Pretrained, golden: Mapping[str, Any]) -> float:
    """Largest distance of a model's rollout from a stated one, in cells."""
    found = _positions(model.emulator, golden["seed"], golden["count"], golden["frames"])
    spacing = torch.tensor(model.emulator.grid.spacing, dtype=torch.float64)
    return float(((found - torch.tensor(golden["position"], dtype=torch.float64)) / spacing).norm(dim=-1).max())


def _positions(emulator: Emulator, seed: int, count: int, frames: int) -> Tensor:
    """(PROBES, D) positions, rounded to 1e-7."""
    state = Pretrained(emulator, {}).example(seed, count)
    last = rollout(emulator, state.to(emulator.device), frames)[0, -1].double().cpu()
    chosen = torch.linspace(0, len(last) - 1, PROBES).long()
    return last[chosen].mul(1e7).round().div(1e7)
