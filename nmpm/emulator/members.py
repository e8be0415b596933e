"""Members: M rollouts from one state, which show how far apart its futures come.

They differ by the noise that a stochastic processor reads; members of a deterministic emulator start from positions
that are displaced by Gaussian numbers, σ cells along each axis. Member k of a scene depends on the seed, on k and on
the scene, not on the number of members: only rounding, which differs between batches, may tell two calls apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.plain_data import check_whole, is_finite
from nmpm.emulator.constraints import distance_beyond
from nmpm.emulator.engines.torch.contact import Contact, obstacle_share
from nmpm.emulator.model import Emulator
from nmpm.errors import ConfigError
from nmpm.particles import Particles

NUDGE = 0.1
"""Standard deviation, in cells, of the displacements of starts where none was calibrated."""
MOST_SCENES = 8
"""Scenes of a batch on a CPU, where more are no faster; networks round alike in batches of 2 to 8."""
MOST_CELLS = 2**21
"""Grid cells of all scenes of a batch, which bound its memory to some GB."""


def check_members(members: Any, seed: Any, nudge: Any) -> None:
    """Raise ConfigError unless there is a member or more, the seed is 0 or more, and so is the nudge, or None."""
    check_whole("members", members, 1)
    check_whole("seed", seed, 0)
    if nudge is not None and not (is_finite(nudge) and nudge >= 0):
        raise ConfigError(f"nudge = {nudge!r}: it must be a number of cells, 0 or more, such as {NUDGE}.")


@torch.no_grad()
def member_starts(
    emulator: Emulator, state: Particles, members: int, seed: int = 0, nudge: float | None = None
) -> Particles:
    """The states (M·B, …) that members start from, rows 0 … B - 1 those of member 0.

    Positions are displaced by Gaussian numbers, but for particles that this would take out of the bounds or into an
    obstacle; velocities stay.

    Args:
        emulator: Whose cells, bounds and obstacles count.
        state: Of B scenes.
        members: M.
        seed: Of the displacements.
        nudge: Standard deviation of the displacements in cells; when left out `NUDGE`, or 0 for emulators that read
            noise.

    Raises:
        ConfigError: if `members`, `seed` or `nudge` is too small.
    """
    check_members(members, seed, nudge)
    scenes, size = len(state.position), nudge_of(emulator, nudge)
    starts = state.scenes(list(range(scenes)) * members)
    if not size:
        return starts
    shift = torch.zeros(starts.position.shape, dtype=torch.float64)
    for row, real in enumerate(starts.mask.cpu()):
        drawn = np.random.default_rng(_sequence(seed, row, scenes)).standard_normal((int(real.sum()), shift.shape[2]))
        shift[row, real] = torch.from_numpy(drawn)
    spacing = starts.position.new_tensor(emulator.grid.spacing)
    moved = starts.with_motion(starts.position + size * spacing * shift.to(starts.position), starts.velocity)
    free = _is_free(emulator, moved).unsqueeze(-1)
    return moved.with_motion(torch.where(free, moved.position, starts.position), starts.velocity)


def mean_pair_distance(members: Tensor) -> Tensor:
    """Mean of |a - b| over the pairs of at least two members, (*S) of (M, *S) numbers."""
    count = len(members)
    rank = torch.arange(1 - count, count, 2, dtype=members.dtype, device=members.device)  # Σ_{i<j} |x_i - x_j|
    distance: Tensor = torch.tensordot(rank, members.sort(dim=0).values, dims=1) / (count * (count - 1) / 2)
    return distance


def nudge_of(emulator: Emulator, nudge: float | None) -> float:
    """The nudge in cells that is stated, or the default: 0 where the processor reads noise."""
    default = 0.0 if emulator.processor.noise else NUDGE
    return default if nudge is None else nudge


def _is_free(emulator: Emulator, state: Particles) -> Tensor:
    """(B, N) bool: whether particles are within the bounds, and outside of obstacles."""
    scene = emulator.scene
    within = distance_beyond(state.position, scene.bounds, [not wraps for wraps in scene.periodic]) <= 0
    if not (scene.obstacles and state.obstacle.shape[1]):
        return within
    share = obstacle_share(emulator.solid(state), emulator.walls)
    return within & ~Contact(share, emulator.grid).inside(emulator.in_cells(state)[0])


def batches_of(emulator: Emulator, rows: int) -> list[range]:
    """The rows of each batch, about as many in all."""
    most = max(1, MOST_CELLS // emulator.grid.size)
    if emulator.device.type == "cpu":
        most = min(most, MOST_SCENES)
    count = -(-rows // most)
    return [range(rows * part // count, rows * (part + 1) // count) for part in range(count)]


def noise_seed(seed: int, row: int, scenes: int) -> int:
    """The seed of the noise of a row of M·B."""
    return int(_sequence(seed, row, scenes).generate_state(1, np.uint64)[0])


def _sequence(seed: int, row: int, scenes: int) -> np.random.SeedSequence:
    """The random state of a row of M·B: of its member of its scene."""
    return np.random.SeedSequence((seed, *divmod(row, scenes)))
