"""Looks for contradictions in a sample of a dataset that takes about a second, for the start of a training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nmpm.data.format import Split, Trajectory, split_paths
from nmpm.data.hdf5 import open_hdf5
from nmpm.data.inspection.dataset_checks import DatasetChecks
from nmpm.data.inspection.findings import Finding, Severity, merge_findings
from nmpm.data.inspection.shared_runs import find_shared_runs
from nmpm.data.loading.sources import DataSource

_TRAJECTORIES = {"train": 2, "valid": 1, "test": 1}
_BYTES = 4 * 2**20  # of positions of a trajectory; of larger ones the first frames are read
_FRAMES = 40  # at least
_COMPARED = 20  # trajectories of a split
_NEED_ALL_FRAMES = frozenset({"still particles", "far bounds", "different domains"})


def find_contradictions(source: DataSource) -> tuple[Finding, ...]:
    """Contradictions in a sample of a source's folder, one of each kind; raises a DataError if it cannot be read."""
    splits = {name: Split(path) for name, path in split_paths(source.folder).items()}
    checks, complete = DatasetChecks(source.metadata), True
    for name, split in splits.items():
        for index in range(0, len(split), -(-len(split) // _TRAJECTORIES[name])):
            trajectory = _read_start(split, index)
            complete &= len(trajectory.position) == split.frames(index)
            checks.add(trajectory, f"{name} {split.names[index]}")
    shared = find_shared_runs(splits, source.metadata, checks.spacing, _COMPARED)
    merged = merge_findings([*checks.compare(), *shared, *checks.findings], checks.trajectories)
    left_out = frozenset[str]() if complete else _NEED_ALL_FRAMES
    return tuple(
        finding for finding in merged if finding.severity == Severity.CONTRADICTION and finding.kind not in left_out
    )


def _read_start(split: Split, index: int) -> Trajectory:
    """The frames of a trajectory up to about 4 MiB, with their times where these are recorded."""
    frames = max(_FRAMES, _BYTES // (4 * split.particles(index) * split.dim))
    trajectory = split.read(index, 0, min(frames, split.frames(index)))
    with open_hdf5(split.path) as file:
        time = file[split.names[index]].get("time")
        recorded = {} if time is None else {"time": np.asarray(time[: len(trajectory.position)])}
    return replace(trajectory, fields=recorded)
