"""Runs that are arrays in memory, as a dataset like those of files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nmpm.data.convert.base import ForeignDataset, Options
from nmpm.data.convert.named_arrays import transposition
from nmpm.data.convert.run_arrays import RunArrays, group_runs
from nmpm.data.convert.run_files import EVERYTHING_UNKNOWN, Facts, Run, open_divided, placeholder_metadata
from nmpm.data.format import Metadata, Trajectory
from nmpm.data.split_files import SPLITS
from nmpm.errors import DataError

Arrays = np.ndarray | Mapping[str, np.ndarray]
Runs = np.ndarray | Iterable[Trajectory | Arrays]
"""Runs as a (R, T, N, D) array, or one by one: (T, N, D) positions, arrays by name, or trajectories."""


@dataclass(frozen=True)
class _MemoryRun(Run):
    """A run in memory; `file` is its number."""

    source: RunArrays | Trajectory = field(kw_only=True)

    def facts(self) -> Facts:
        if isinstance(self.source, RunArrays):
            return self.source.facts()
        if self.source.metadata is not None:
            return self.source.metadata, frozenset(), ()
        return placeholder_metadata(self.source.position.shape[2]), EVERYTHING_UNKNOWN, ()

    def read(self, metadata: Metadata) -> Trajectory:
        source = self.source
        return self.take(source if isinstance(source, Trajectory) else source.read(self.index, metadata))


def open_runs(runs: Runs | Mapping[str, Runs], options: Options) -> ForeignDataset:
    """The dataset of runs in memory: by split as a dict states them, else divided by `divide`.

    Raises:
        DataError: if there are none, or arrays do not fit together; names the run.
        ConfigError: if an option is invalid.
    """
    divided = isinstance(runs, Mapping) and set(runs) <= set(SPLITS)
    parts: Mapping[str, Any] = runs if isinstance(runs, Mapping) and divided else {"all": runs}
    splits = {name: list(_each(part, f"{name} " if divided else "")) for name, part in parts.items()}
    first = next((part[0] for part in splits.values() if part), None)
    if first is None:
        raise DataError("There are no runs to write.")
    return open_divided(splits, first.facts(), _read, options)


def _read(runs: Sequence[_MemoryRun], metadata: Metadata) -> Iterator[Trajectory]:
    return (run.read(metadata) for run in runs)


def _each(runs: Runs | Mapping[str, Any], where: str) -> Iterator[_MemoryRun]:
    items = [runs] if isinstance(runs, Mapping | np.ndarray | Trajectory) else runs
    for number, item in enumerate(items):
        name = f"{where}run {number}"
        if isinstance(item, Trajectory):
            yield _MemoryRun(Path(name), 0, len(item.position), source=item)
            continue
        named = item if isinstance(item, Mapping) else {"position": item}
        arrays = {key: np.asarray(array) for key, array in named.items()}
        groups = list(group_runs(arrays, name))
        if not groups:
            shapes = ", ".join(f"{key} {array.shape}" for key, array in arrays.items())
            found = transposition(max(arrays.values(), key=np.size))
            mend = "" if found is None else f" Its axes look like ({found[1]}): np.transpose(…, {found[0]})."
            raise DataError(f"{name}: none of the arrays is (T, N, D) or (R, T, N, D) positions ({shapes}).{mend}")
        for group in groups:
            yield from (_MemoryRun(Path(name), index, group.frames, source=group) for index in range(group.count))
