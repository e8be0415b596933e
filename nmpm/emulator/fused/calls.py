"""The kernels for a batch of scenes as functions of tensors: p2g, the way through a bundle, and back to domain length.

Shapes as in `nmpm.particles`; tensors are float32 on the CPU and carry no gradients.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nmpm.emulator.fused.arrays import as_array, material_rows
from nmpm.emulator.fused.batch import Batch, fly_batch, land_batch, rasterise_batch, spread_batch
from nmpm.emulator.fused.plan import Array, Plan
from nmpm.emulator.fused.surroundings import Surroundings, survey, survey_rollout

__all__ = ["predict_path", "rasterise", "survey", "survey_rollout", "to_length", "uncrowd"]

_NONE = np.empty(0, np.float32)


def rasterise(
    plan: Plan, position: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, solid: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Particles in grid units, and the grid state.

    Returns:
        (B, N, D) positions, (B, N, D) velocities and (B, 1, D) gravity in cells; (B, C_in, *S) grid state, whose
        channels lie next to each other in memory.
    """
    kinds = material_rows(material, len(plan.mass))
    found = rasterise_batch(
        plan, as_array(position), as_array(velocity), as_array(gravity), kinds, as_array(mask), as_array(solid)
    )
    cells, moved, pull = map(torch.from_numpy, (found.cells, found.velocity, found.gravity))
    return cells, moved, pull.unsqueeze(1), to_grid(plan, found.state)


def to_grid(plan: Plan, rows: Array) -> Tensor:
    """Rows (B, size, C), one per node, as a tensor (B, C, *S) of the same memory."""
    return torch.from_numpy(rows.reshape(len(rows), *plan.shape, rows.shape[2])).movedim(-1, 1)


def predict_path(
    plan: Plan, cells: Tensor, velocity: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, state: Tensor,
    output: Tensor, scale: Tensor, solid: Tensor, walls: Tensor, budget: Tensor | None, readable: Tensor | None = None,
    surroundings: Sequence[Surroundings] | None = None,
) -> Tensor:  # fmt: skip
    """(B, m, N, D) positions in cells, as `Advection.constrained_path` gives them.

    The surroundings of each scene, from `survey` or `survey_rollout`, are found where they are left out.

    Raises:
        UncoveredReadError: if a particle reads the output where it must not, see `Departure`.
        IndexError: if a particle's material is none of the scene's.
    """
    rows = as_array(state.movedim(1, -1)).reshape(len(state), plan.size, state.shape[1])
    kinds = material_rows(material, len(plan.mass))
    start = Batch(as_array(cells), as_array(velocity), as_array(gravity)[:, 0], kinds, as_array(mask), rows)
    known = survey(plan, solid, walls) if surroundings is None else surroundings
    allowed, cells_read = (None if own is None else as_array(own) for own in (budget, readable))
    return torch.from_numpy(fly_batch(plan, start, output, as_array(scale).reshape(-1), allowed, cells_read, known))


def uncrowd(
    plan: Plan, cells: Tensor, gravity: Tensor, material: Tensor, mask: Tensor, path: Tensor, solid: Tensor,
    walls: Tensor, budget: Tensor | None, surroundings: Sequence[Surroundings] | None = None,
) -> Tensor:  # fmt: skip
    """(B, m, N, D) positions with overfull cells spread, as `Advection.uncrowded_path` gives them; in fresh memory.

    From a path (B, m, N, D) of `predict_path`, and by a plan with a density cap.
    """
    known = survey(plan, solid, walls) if surroundings is None else surroundings
    kinds = material_rows(material, len(plan.mass))
    start = Batch(as_array(cells), _NONE, as_array(gravity)[:, 0], kinds, as_array(mask), _NONE)
    allowed = None if budget is None else as_array(budget)
    return torch.from_numpy(spread_batch(plan, start, as_array(path), allowed, known))


def to_length(plan: Plan, path: Tensor) -> Tensor:
    """The path (B, m, N, D) in domain length, in its own memory."""
    land_batch(plan, path.numpy())
    return path
