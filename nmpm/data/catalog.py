"""The embedded datasets, simulated on first use instead of downloaded.

`ensure("goop")` returns the folder of a dataset in the native layout, and simulates it first if it is missing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType

from nmpm._support.shipped import user_home
from nmpm.data.format import METADATA_FILE, read_metadata
from nmpm.data.generate import generate
from nmpm.data.simulation_request import SimulationRequest, same_trajectories
from nmpm.errors import DataError
from nmpm.scene import Scene
from nmpm.sim import load_preset, preset_names


@dataclass(frozen=True)
class CatalogEntry:
    """An embedded dataset.

    Args:
        name: Its name.
        preset: Name of the simulator's preset.
        counts: Trajectories in each of the splits train, valid and test.
        seed: The seeds of all trajectories are derived from it.
        paper: Trajectories per split in the paper's dataset of the same name, for `nmpm simulate`.
    """

    name: str
    preset: str
    counts: Mapping[str, int]
    paper: Mapping[str, int]
    seed: int = 0


def _splits(train: int, valid: int, test: int) -> Mapping[str, int]:
    return MappingProxyType({"train": train, "valid": valid, "test": test})


_USUAL = (_splits(200, 10, 30), _splits(1000, 100, 100))
"""A number that is simulated within minutes; the number in the paper (arXiv 2408.15753)."""

_COUNTS = {
    "goop": (_USUAL[0], _splits(1000, 30, 30)),
    "dambreak2d": (_splits(50, 25, 25),) * 2,
    "wbcsph": (_splits(30, 9, 9),) * 2,
}


@cache
def _entries() -> Mapping[str, CatalogEntry]:
    """One dataset for each shipped preset."""
    return MappingProxyType({name: CatalogEntry(name, name, *_COUNTS.get(name, _USUAL)) for name in preset_names()})


def dataset_home() -> Path:
    """The cache folder of datasets."""
    return user_home()


def catalog() -> tuple[str, ...]:
    """Names of the embedded datasets."""
    return tuple(_entries())


def describe(name: str) -> CatalogEntry:
    """The catalog's entry for an embedded dataset.

    Raises:
        DataError: if there is no dataset of that name.
    """
    if name not in _entries():
        raise DataError(
            f"No embedded dataset is called {name!r}; known: {', '.join(_entries())}. For your own data, give"
            " the path of their folder."
        )
    return _entries()[name]


def scene(name: str) -> Scene:
    """The scene of an embedded dataset; simulates nothing.

    Raises:
        DataError: if there is no dataset of that name.
    """
    return load_preset(describe(name).preset).scene


def simulation_request(
    name: str, counts: Mapping[str, int] | None = None, frames: int | None = None, seed: int | None = None
) -> SimulationRequest:
    """The request that `ensure` simulates for the same arguments.

    Raises:
        DataError: if there is no dataset of that name.
        ConfigError: if counts or frames are invalid.
    """
    entry = describe(name)
    preset = load_preset(entry.preset)
    preset = preset if frames is None else preset.with_frames(frames)
    return SimulationRequest(preset, entry.counts if counts is None else counts, entry.seed if seed is None else seed)


def dataset_folder(name: str, request: SimulationRequest) -> Path:
    """The folder of a request in the cache: the name and a hash of all that determines the data."""
    fingerprint = hashlib.sha256(json.dumps(request.to_dict(), sort_keys=True).encode()).hexdigest()[:10]
    return dataset_home() / "datasets" / f"{name}-{fingerprint}"


def find_simulated(name: str, test: int) -> Path | None:
    """A complete folder of an embedded dataset with at least `test` test trajectories, for whatever it was simulated.

    Trajectories do not depend on how many there are, so that those of a training's data serve as well.

    Raises:
        DataError: if there is no dataset of that name.
    """
    found = _complete_folders(name, simulation_request(name))
    return next((folder for folder, counts in found if counts.get("test", 0) >= test), None)


def _complete_folders(name: str, request: SimulationRequest) -> Iterator[tuple[Path, Mapping[str, int]]]:
    """Complete folders that differ from the request in their counts at most, with these counts."""
    wanted = request.to_dict()
    for folder in sorted((dataset_home() / "datasets").glob(f"{name}-*")):
        if not (folder / METADATA_FILE).is_file():
            continue
        found = read_metadata(folder).extra.get("simulation", {})
        if same_trajectories(found, wanted):
            yield folder, found.get("counts", {})


def _largest_folder(name: str, request: SimulationRequest) -> Path | None:
    """The complete folder with the most trajectories of the request's kind."""
    counts = dict(_complete_folders(name, request))
    return max(counts, key=lambda folder: sum(counts[folder].values()), default=None)


def ensure(
    name: str,
    counts: Mapping[str, int] | None = None,
    frames: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
) -> Path:
    """The folder of an embedded dataset, which is simulated now if it is missing.

    Trajectories that another folder of it has, of fewer or more in all, are copied.

    Args:
        name: One of `catalog()`.
        counts: Trajectories in each of the splits train, valid and test; the dataset's own when left out.
        frames: Simulated frames of a trajectory; the preset's own when left out.
        seed: The seeds of all trajectories are derived from it; the dataset's own when left out.
        workers: Trajectories simulated at a time; one per processor core when left out.

    Raises:
        DataError: if there is no dataset of that name, or its folder cannot be written.
        ConfigError: if counts or frames are invalid.
    """
    request = simulation_request(name, counts, frames, seed)
    folder = dataset_folder(name, request)
    known = None if (folder / METADATA_FILE).is_file() else _largest_folder(name, request)
    generate(request.preset, folder, request.counts, request.seed, workers, known)
    return folder
