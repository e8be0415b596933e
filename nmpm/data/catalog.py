"""The embedded datasets, simulated on first use instead of downloaded.

`ensure("goop")` returns the folder of a dataset in the native layout, and simulates it first if it is missing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from nmpm._support.shipped import check_dataset, user_home
from nmpm.data.format import METADATA_FILE, read_metadata
from nmpm.data.simulation import SimulationRequest, generate, same_trajectories
from nmpm.sim import load_preset


@dataclass(frozen=True)
class CatalogEntry:
    """Trajectories per split of an embedded dataset, and of the paper's of the same name, for `nmpm simulate`."""

    counts: Mapping[str, int]
    paper: Mapping[str, int]


def _splits(train: int, valid: int, test: int) -> Mapping[str, int]:
    return MappingProxyType({"train": train, "valid": valid, "test": test})


_USUAL = CatalogEntry(counts=_splits(200, 10, 30), paper=_splits(1000, 100, 100))
"""Simulated within minutes; the paper's (arXiv 2408.15753)."""
_OTHERS = {
    "goop": CatalogEntry(_USUAL.counts, _splits(1000, 30, 30)),
    "dambreak2d": CatalogEntry(_splits(50, 25, 25), _splits(50, 25, 25)),
    "wbcsph": CatalogEntry(_splits(30, 9, 9), _splits(30, 9, 9)),
}


def describe(name: str) -> CatalogEntry:
    """The catalog's entry for an embedded dataset; raises a DataError if there is none of that name."""
    check_dataset(name)
    return _OTHERS.get(name, _USUAL)


def simulation_request(
    name: str, counts: Mapping[str, int] | None = None, frames: int | None = None, seed: int | None = None
) -> SimulationRequest:
    """The request that `ensure` simulates for the same arguments."""
    entry, preset = describe(name), load_preset(name)
    preset = preset if frames is None else preset.with_frames(frames)
    return SimulationRequest(preset, entry.counts if counts is None else counts, seed or 0)


def dataset_folder(name: str, request: SimulationRequest) -> Path:
    """The folder of a request in the cache: the name and a hash of all that determines the data."""
    fingerprint = hashlib.sha256(json.dumps(request.to_dict(), sort_keys=True).encode()).hexdigest()[:10]
    return user_home() / "datasets" / f"{name}-{fingerprint}"


def find_simulated(name: str, test: int) -> Path | None:
    """A complete folder of an embedded dataset with at least `test` test trajectories, if there is one."""
    folders = _complete_folders(name, simulation_request(name))
    return next((folder for folder, counts in folders if counts.get("test", 0) >= test), None)


def find_data(data: Path, split: str | None = None, index: int = 0) -> Path:
    """The file or folder of data; of an embedded dataset the folder, simulated first if it lacks the trajectory."""
    if data.exists():
        return data
    counts = {"train": 0, "valid": 0, "test": 0} | {split or "test": index + 1}
    simulated = find_simulated(str(data), index + 1) if split in (None, "test") else None
    return simulated or ensure(str(data), counts)


def _complete_folders(name: str, request: SimulationRequest) -> Iterator[tuple[Path, Mapping[str, int]]]:
    """Complete folders that differ from the request in their counts at most, with these counts."""
    wanted = request.to_dict()
    for folder in sorted((user_home() / "datasets").glob(f"{name}-*")):
        if not (folder / METADATA_FILE).is_file():
            continue
        stored = read_metadata(folder).extra.get("simulation", {})
        if same_trajectories(stored, wanted):
            yield folder, stored.get("counts", {})


def ensure(
    name: str,
    counts: Mapping[str, int] | None = None,
    frames: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
) -> Path:
    """The folder of an embedded dataset, which is simulated now if it is missing; raises as `generate`.

    Trajectories do not depend on how many there are: those that another folder of it has are copied.

    Args:
        name: One of `nmpm.sim.preset_names()`.
        counts: Trajectories in each of the splits train, valid and test; the dataset's own when left out.
        frames: Simulated frames of a trajectory; the preset's own when left out.
        seed: The seeds of all trajectories are derived from it; 0 when left out.
        workers: Trajectories simulated at a time; one per processor core when left out.
    """
    request = simulation_request(name, counts, frames, seed)
    folder, largest = dataset_folder(name, request), None
    if not (folder / METADATA_FILE).is_file():
        others = dict(_complete_folders(name, request))
        largest = max(others, key=lambda other: sum(others[other].values()), default=None)
    generate(request.preset, folder, request.counts, request.seed, workers, largest)
    return folder
