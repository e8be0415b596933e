"""Looks for contradictions in a sample of a dataset that takes about a second, for the start of a training."""

from __future__ import annotations

import shlex
from dataclasses import replace

import numpy as np

from nmpm._support.messages import one_line
from nmpm.data.format import Split, Trajectory
from nmpm.data.hdf5 import open_hdf5
from nmpm.data.inspection.dataset_checks import DatasetChecks
from nmpm.data.inspection.findings import Finding, Severity, merge_findings
from nmpm.data.inspection.shared_runs import find_shared_runs
from nmpm.data.loading.sources import FolderSource
from nmpm.data.split_files import split_paths
from nmpm.errors import DataError

_TRAJECTORIES = {"train": 2, "valid": 1, "test": 1}
_BYTES = 4 * 2**20  # of positions of a trajectory; of larger ones the first frames are read
_FRAMES = 40  # at least
_COMPARED = 20  # trajectories of a split
_SHOWN, _WIDTH = 3, 120  # findings in a warning, and characters of a line
_NEED_ALL_FRAMES = frozenset({"still particles", "far bounds", "different domains"})


def contradictions_warning(source: FolderSource) -> str:
    """Up to five lines that name contradictions in a sample of a dataset; empty if there are none."""
    try:
        findings = find_contradictions(source)
    except DataError:  # the training names what cannot be read
        return ""
    if not findings:
        return ""
    shown = [f"  - {one_line(f'{finding.kind}: {finding.sentence}', _WIDTH)}" for finding in findings[:_SHOWN]]
    more = f" (and {len(findings) - _SHOWN} more)" if len(findings) > _SHOWN else ""
    command = shlex.join(["nmpm", "inspect", str(source.path), *stated_options(source)])
    return "\n".join(["Warning: these data contradict themselves:", *shown, f"  All of it{more}: {command}", ""])


def stated_options(source: FolderSource) -> list[str]:
    """The options by which `nmpm inspect`, `rollout` and `trade` read a dataset as this source does."""
    options = source.options
    stated = {
        "family": options.family,
        "axes": options.axes,
        "gravity": options.gravity and ",".join(f"{value:.12g}" for value in options.gravity),
        "boundary": options.boundary and ",".join(options.boundary),
        "bounds": options.bounds and ",".join(f"{low:.12g}:{high:.12g}" for low, high in options.bounds),
        "fields": options.fields and ",".join(options.fields),
        "prescribed": options.prescribed and ",".join(map(str, sorted(options.prescribed))),
        "resample": options.resample,
        "smooth": options.smooth,
    }
    return [f"--{name}={value}" for name, value in stated.items() if value]


def find_contradictions(source: FolderSource) -> tuple[Finding, ...]:
    """Contradictions in a sample of a dataset, one of each kind; raises a DataError if it cannot be read."""
    splits = {name: Split(path) for name, path in split_paths(source.folder).items()}
    checks, complete = DatasetChecks(source.metadata), True
    for name, split in splits.items():
        for index in range(0, len(split), -(-len(split) // _TRAJECTORIES[name])):
            trajectory = _read_start(split, index)
            complete &= len(trajectory.position) == split.frames(index)
            checks.add(trajectory, f"{name} {split.names[index]}")
    shared = find_shared_runs(splits, source.metadata, checks.spacing, _COMPARED)
    merged = merge_findings([*shared, *checks.result()], checks.trajectories)
    left_out = frozenset[str]() if complete else _NEED_ALL_FRAMES
    return tuple(
        finding for finding in merged if finding.severity == Severity.CONTRADICTION and finding.kind not in left_out
    )


def _read_start(split: Split, index: int) -> Trajectory:
    """The frames of a trajectory up to about 4 MiB, with their times and velocities where these are recorded."""
    frames = max(_FRAMES, _BYTES // (4 * split.particles(index) * split.dim))
    trajectory = split.read(index, 0, min(frames, split.frames(index)))
    with open_hdf5(split.path) as file:
        group = file[split.names[index]]
        recorded = {
            name: np.asarray(group[name][: len(trajectory.position)]) for name in ("time", "velocity") if name in group
        }
    return replace(trajectory, fields=recorded)
