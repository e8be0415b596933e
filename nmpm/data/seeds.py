"""Seeds of simulated trajectories, and the ones that take the place of seeds whose simulations become unstable."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from nmpm.errors import UnstableError
from nmpm.sim import Preset
from nmpm.sim.trajectory import Progress, SimulatedTrajectory

DRAWS = 5
"""Seeds tried for one trajectory; a preset that is unstable as often in a row is at fault, not the seed."""

_log = logging.getLogger(__name__)

Simulated = TypeVar("Simulated")


def derive_seed(*entropy: int) -> int:
    """A seed that depends on all the numbers."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of_draw(place: tuple[int, ...], draw: int) -> int:
    """The seed of a trajectory after `draw` others turned out unstable.

    Args:
        place: The dataset's seed and what tells the trajectory from the dataset's others.
        draw: 0 for the first seed.
    """
    return derive_seed(*place, draw) if draw else derive_seed(*place)


def try_seeds(place: tuple[int, ...], simulate: Callable[[int], Simulated]) -> Simulated:
    """What is simulated from the first of a trajectory's seeds that stays stable; a warning names each that does not.

    Args:
        place: As for `seed_of_draw`.
        simulate: Simulates from a seed.

    Raises:
        UnstableError: if none of `DRAWS` seeds stays stable.
    """
    for draw in range(DRAWS):
        seed = seed_of_draw(place, draw)
        try:
            return simulate(seed)
        except UnstableError as error:
            _log.warning("Another seed takes the place of %d, which is unstable. %s", seed, error)
            last = error
    raise UnstableError(f"{DRAWS} seeds in a row are unstable; the last: {last}") from last


def simulate_first_stable(
    preset: Preset, place: tuple[int, ...], progress: Progress | None = None
) -> SimulatedTrajectory:
    """A preset's trajectory, see `try_seeds`; `progress` is called after each frame.

    Raises:
        UnstableError: if no seed stays stable.
        ConfigError: if no initial state fits into the box.
    """
    return try_seeds(place, lambda seed: preset.simulate(seed, progress))
