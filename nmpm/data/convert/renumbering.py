"""Changes particle type ids for other readers; LagrangeBench, for example, expects 0 fluid and 1 wall."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from nmpm.data.convert.base import ForeignDataset, Rereadable
from nmpm.data.format import Trajectory
from nmpm.errors import ConfigError


def renumber_types(source: ForeignDataset, ids: Mapping[int, int]) -> ForeignDataset:
    """The same dataset with other particle type ids; names and static types follow.

    Args:
        source: The dataset.
        ids: New ids by old ones; other ids stay.

    Raises:
        ConfigError: if two types would get the same id, or an old id is unknown.
    """
    metadata = source.metadata
    unknown = sorted(set(ids) - set(metadata.particle_types))
    if unknown:
        known = ", ".join(f"{i} {name}" for i, name in sorted(metadata.particle_types.items()))
        raise ConfigError(f"There is no particle type {', '.join(map(str, unknown))}; known: {known}.")
    # A type whose id is requested for another and that is not renumbered itself is dropped; `_renumber` checks that it
    # does not occur.
    kept = {i: name for i, name in metadata.particle_types.items() if i in ids or i not in ids.values()}
    types = {ids.get(i, i): name for i, name in kept.items()}
    if len(types) < len(kept):
        raise ConfigError(f"{dict(ids)} gives two particle types the same id.")
    static = frozenset(ids.get(i, i) for i in metadata.static_types if i in kept)
    return replace(
        source,
        metadata=replace(metadata, particle_types=types, static_types=static),
        splits={name: Rereadable(partial(_renumber, split, ids, kept)) for name, split in source.splits.items()},
    )


def _renumber(split: Iterable[Trajectory], ids: Mapping[int, int], kept: Mapping[int, str]) -> Iterator[Trajectory]:
    for trajectory in split:
        old = trajectory.particle_type
        dropped = sorted(set(np.unique(old).tolist()) - set(kept))
        if dropped:
            raise ConfigError(
                f"Particle type {dropped[0]} occurs, but its id is given to another type; give it a new one."
            )
        new = old.copy()
        for before, after in ids.items():
            new[old == before] = after
        yield replace(trajectory, particle_type=new)
