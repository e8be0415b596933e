"""Runs that are arrays in memory, as a dataset like those of files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.data.convert.array_files import array_facts
from nmpm.data.convert.base import ForeignDataset, Options
from nmpm.data.convert.run_arrays import RunArrays, group_runs
from nmpm.data.convert.run_files import EVERYTHING_UNKNOWN, Run, cut, divide, placeholder_metadata
from nmpm.data.format import SPLITS, Metadata, Trajectory
from nmpm.errors import DataError

Arrays = np.ndarray | Mapping[str, np.ndarray]
Runs = np.ndarray | Iterable[Trajectory | Arrays]
"""Runs as a (R, T, N, D) array, or one by one: (T, N, D) positions, arrays by name, or trajectories."""


@dataclass(frozen=True)
class _MemoryRun(Run):
    """A run in memory; `file` is its number."""

    source: RunArrays | Trajectory = field(kw_only=True)

    def read(self, metadata: Metadata) -> Trajectory:
        if isinstance(self.source, Trajectory):
            trajectory = self.source
        else:
            ids = {name: i for i, name in metadata.particle_types.items()}
            trajectory = self.source.read(self.index, metadata.dim, ids)
        return trajectory if self.part is None else cut(trajectory, self.part)


def open_runs(runs: Runs | Mapping[str, Runs], options: Options) -> ForeignDataset:
    """The dataset of runs in memory: by split as a dict states them, else divided by `divide`.

    Raises:
        DataError: if there are none, or arrays do not fit together; names the run.
        ConfigError: if an option is invalid.
    """
    notes: tuple[str, ...] = ()
    if isinstance(runs, Mapping) and set(runs) <= set(SPLITS):
        splits: Mapping[str, Sequence[_MemoryRun]] = {
            name: list(_each(part, f"{name} ")) for name, part in runs.items()
        }
    else:
        splits, notes = divide(list(_each(runs, "")))
    first = next((part[0].source for part in splits.values() if part), None)
    if first is None:
        raise DataError("There are no runs to write.")
    stated, unknown, arrays = _facts(first)
    metadata = options.apply_to(stated)
    return ForeignDataset(
        metadata,
        {name: partial(_read, part, metadata) for name, part in splits.items()},
        (*arrays, *notes),
        {name: len(part) for name, part in splits.items()},
        unknown=unknown - options.stated,
    )


def _read(runs: Sequence[_MemoryRun], metadata: Metadata) -> Iterator[Trajectory]:
    return (run.read(metadata) for run in runs)


def _facts(first: RunArrays | Trajectory) -> tuple[Metadata, frozenset[str], tuple[str, ...]]:
    if isinstance(first, RunArrays):
        return array_facts(first)
    if first.metadata is not None:
        return first.metadata, frozenset(), ()
    return placeholder_metadata(first.position.shape[2]), EVERYTHING_UNKNOWN, ()


def _each(runs: Runs | Mapping[str, Any], where: str) -> Iterator[_MemoryRun]:
    items = [runs] if isinstance(runs, Mapping | np.ndarray | Trajectory) else runs
    for number, item in enumerate(items):
        name = f"{where}run {number}"
        if isinstance(item, Trajectory):
            yield _MemoryRun(Path(name), 0, len(item.position), source=item)
            continue
        arrays = item if isinstance(item, Mapping) else {"position": item}
        groups = list(group_runs({key: np.asarray(array) for key, array in arrays.items()}, name))
        if not groups:
            shapes = ", ".join(f"{key} {np.shape(array)}" for key, array in arrays.items())
            raise DataError(f"{name}: none of the arrays is (T, N, D) or (R, T, N, D) positions ({shapes}).")
        for group in groups:
            yield from (_MemoryRun(Path(name), index, group.frames, source=group) for index in range(group.count))
