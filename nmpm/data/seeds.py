"""Seeds of simulated trajectories, and their replacements where a simulation becomes unstable."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from nmpm.errors import UnstableError
from nmpm.sim import Preset
from nmpm.sim.state import Progress, SimulatedTrajectory

DRAWS = 5
"""Seeds tried for one trajectory; if all are unstable, the preset is at fault."""

_log = logging.getLogger(__name__)

Simulated = TypeVar("Simulated")


def derive_seed(*entropy: int) -> int:
    """A seed that depends on all the numbers."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of_draw(entropy: tuple[int, ...], draw: int) -> int:
    """The seed of a trajectory after `draw` seeds before it were unstable.

    Args:
        entropy: Numbers that identify the trajectory: the dataset's seed, and its split and index or the like.
        draw: 0 for the first seed.
    """
    return derive_seed(*entropy, draw) if draw else derive_seed(*entropy)


def try_seeds(entropy: tuple[int, ...], simulate: Callable[[int], Simulated]) -> Simulated:
    """The simulation from the first stable seed of a trajectory; logs a warning for each unstable one.

    Args:
        entropy: As for `seed_of_draw`.
        simulate: Simulates from a seed.

    Raises:
        UnstableError: if none of `DRAWS` seeds stays stable.
    """
    for draw in range(DRAWS):
        seed = seed_of_draw(entropy, draw)
        try:
            return simulate(seed)
        except UnstableError as error:
            _log.warning("Another seed takes the place of %d, which is unstable. %s", seed, error)
            last = error
    raise UnstableError(f"{DRAWS} seeds in a row are unstable; the last: {last}") from last


def simulate_first_stable(
    preset: Preset, entropy: tuple[int, ...], progress: Progress | None = None
) -> SimulatedTrajectory:
    """A preset's trajectory, see `try_seeds`; `progress` is called after each frame.

    Raises:
        UnstableError: if no seed stays stable.
        ConfigError: if no initial state fits into the box.
    """
    return try_seeds(entropy, lambda seed: preset.simulate(seed, progress))
