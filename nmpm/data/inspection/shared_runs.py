"""Finds trajectories that occur twice, in two splits or in one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from nmpm.data.format import Metadata, Split
from nmpm.data.inspection.findings import Finding, Severity
from nmpm.errors import DataError

_PARTICLES = 32  # that move, and as many that do not
_SAME_RUN = 0.3  # spacings that a particle of two runs may be apart
_SAME_START = 1e-3


@dataclass(frozen=True)
class _Run:
    """Positions of some particles in the first two frames (2, K, D) and in the last one (K, D), and attributes."""

    split: str
    name: str
    start: np.ndarray
    end: np.ndarray
    frames: int
    attributes: dict[str, Any]


_Pairs = dict[tuple[str, str], list[tuple[_Run, _Run]]]


def find_shared_runs(
    splits: Mapping[str, Split], metadata: Metadata, spacing: float, most: int = 500
) -> Iterator[Finding]:
    """Yields findings about trajectories of different splits, or of one, that are the same or start the same.

    Compared are some particles in the first two frames and in the last one, of so many trajectories of each split.
    """
    groups: dict[tuple[int, ...], list[_Run]] = {}
    for run, particles in _read_runs(splits, metadata, most):
        groups.setdefault((particles, *run.start.shape), []).append(run)
    same, starts = _Pairs(), _Pairs()
    for runs in groups.values():
        tree = cKDTree(np.stack([run.start.ravel() for run in runs]))
        for i, j in sorted(tree.query_pairs(_SAME_RUN * spacing, p=np.inf)):
            one, other = runs[i], runs[j]
            if one.frames == other.frames and np.abs(one.end - other.end).max() <= _SAME_RUN * spacing:
                same.setdefault((one.split, other.split), []).append((one, other))
            elif np.abs(one.start - other.start).max() <= _SAME_START * spacing and one.attributes == other.attributes:
                starts.setdefault((one.split, other.split), []).append((one, other))
    yield from _describe(same, splits, "shared trajectories", "are the same")
    yield from _describe(starts, splits, "shared starts", "have the same first two frames")


def _read_runs(splits: Mapping[str, Split], metadata: Metadata, most: int) -> Iterator[tuple[_Run, int]]:
    for name, split in splits.items():
        for index in range(0, len(split), -(-len(split) // most)):
            try:
                start = split.read(index, 0, 2)
                end = split.read(index, split.frames(index) - 1).position[0]
            except DataError:
                continue
            moves = metadata.is_moving(start.particle_type)
            picked = np.concatenate([_evenly(np.flatnonzero(moves)), _evenly(np.flatnonzero(~moves))])
            attributes = {key: np.asarray(value).tolist() for key, value in start.attributes.items() if key != "seed"}
            frames = split.frames(index)
            positions = np.nan_to_num(start.position[:, picked]), np.nan_to_num(end[picked])
            yield _Run(name, split.names[index], *positions, frames, attributes), len(moves)


def _evenly(indices: np.ndarray) -> np.ndarray:
    return indices[:: max(1, -(-len(indices) // _PARTICLES))]


def _describe(pairs: _Pairs, splits: Mapping[str, Split], kind: str, what: str) -> Iterator[Finding]:
    """Yields a finding for pairs of different splits, a contradiction if they are the same; else for those of one."""
    across = {names: found for names, found in pairs.items() if names[0] != names[1]}
    for (first, second), found in list((across or pairs).items())[:1]:
        one, other = found[0]
        count = len({b.name for _, b in found})
        whole = f"all {count}" if count == len(splits[second]) > 1 else f"{count} of {len(splits[second])}"
        leak = f"{second} says nothing about new scenes" if across else "they count twice"
        yield Finding(
            kind,
            Severity.CONTRADICTION if across and "are the same" in what else Severity.ODDITY,
            f"{first} and {second}: {whole} trajectories {what}, e.g. {one.split} {one.name} and {other.split}"
            f" {other.name}: {leak}.",
            factor=count / len(splits[second]),
        )
