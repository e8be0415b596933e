"""Simulates datasets in parallel; resumes after an interruption; gives the same bytes for any number of workers.

An unfinished folder contains `.parts`, with the request and a file for each finished trajectory. When all parts of a
split are there they are assembled into its HDF5 file; `metadata.json` is written last and marks the dataset as
complete. Files are written atomically, so that a repeated call continues where the last one stopped.

Shards are processes that write different parts to the same folder at the same time, under a shared lock; whoever
assembles the parts holds an exclusive lock.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue

from nmpm._support.atomic import atomic_write, lock_folder, temporary_files
from nmpm._support.progress import progress_bar
from nmpm._support.threads import usable_cores
from nmpm._support.version import __version__
from nmpm.data.format import (
    METADATA_FILE,
    SPLITS,
    Metadata,
    Split,
    read_metadata,
    write_metadata,
    write_split,
)
from nmpm.data.parts import PARTS, explain_write_errors, part_path, read_parts, request_path, write_part
from nmpm.data.seeds import DRAWS, seed_of_draw
from nmpm.data.shard import Shard
from nmpm.data.simulation_request import SimulationRequest
from nmpm.data.simulation_workers import Worker, started_workers
from nmpm.data.statistics import MotionStatistics
from nmpm.errors import DataError
from nmpm.sim import Preset
from nmpm.sim.preset import BOUNDARY

_KEY = "simulation"

_log = logging.getLogger(__name__)


def generate(
    preset: Preset,
    folder: Path,
    counts: Mapping[str, int],
    seed: int = 0,
    workers: int | None = None,
    known: Path | None = None,
) -> None:
    """Simulates a dataset into a folder, unless it is complete already.

    Several processes may call this for the same folder: the first one simulates, the others wait for it.

    Args:
        preset: The family of scenes.
        folder: The dataset's folder; created if missing.
        counts: Trajectories in each of the splits train, valid and test; no file is written for 0.
        seed: The seeds of all trajectories are derived from it.
        workers: Trajectories simulated at a time; one per processor core when left out. Where there is much to
            simulate, each is a process, of about 200 MB.
        known: A complete dataset of the same preset, revision of its simulator and seed, whose trajectories are copied.

    Raises:
        ConfigError: if preset or counts are invalid.
        DataError: if the folder has other data than requested, or cannot be written, or `known` cannot be read.
    """
    request, folder = SimulationRequest(preset, counts, seed), Path(folder)
    if _is_complete(request, folder):  # without the lock, which needs a writable folder
        return
    with explain_write_errors(folder), lock_folder(folder):
        _complete(request, folder, workers or usable_cores(), known)


def generate_shard(
    preset: Preset,
    folder: Path,
    counts: Mapping[str, int],
    shard: Shard,
    seed: int = 0,
    workers: int | None = None,
) -> int:
    """Simulates a shard of a dataset; the shard that finishes last completes the dataset.

    Shards may run at the same time in the same folder. The folder then has the bytes that `generate` writes. Arguments
    and errors are those of `generate`.

    Returns:
        Number of trajectories that other shards have yet to simulate; 0 if the dataset is complete.
    """
    request, folder = SimulationRequest(preset, counts, seed), Path(folder)
    if _is_complete(request, folder):
        return 0
    with explain_write_errors(folder), lock_folder(folder, shared=True):
        if _is_complete(request, folder):
            return 0
        with lock_folder(folder / PARTS):
            _prepare_parts(request, folder)
        _simulate_parts(request, folder, shard.select(request.trajectories), workers or usable_cores())
        # While the lock is held nobody assembles: the last shard to come here finds all parts.
        missing = len(_missing(folder, request.trajectories))
    if missing == 0:
        generate(preset, folder, counts, seed, workers)
    return missing


def _complete(request: SimulationRequest, folder: Path, workers: int, known: Path | None) -> None:
    if _is_complete(request, folder):
        return
    _prepare_parts(request, folder)
    _remove_stale_files(folder)
    if known is not None:
        _copy_parts(request, folder, known)
    _simulate_parts(request, folder, request.trajectories, workers)
    for split in request.splits:
        _assemble(request, folder, split)
    metadata = preset_metadata(request.preset)
    first, statistics = Split(folder / f"{request.splits[0]}.h5"), MotionStatistics(metadata)
    for index in range(len(first)):
        statistics.add(first.read(index))
    redrawn = _find_redrawn(request, folder)
    simulation = request.to_dict() | ({"redrawn": redrawn} if redrawn else {})
    extra = metadata.extra | statistics.result() | {_KEY: simulation}
    write_metadata(folder, dataclasses.replace(metadata, extra=extra))
    shutil.rmtree(folder / PARTS, ignore_errors=True)


def _is_complete(request: SimulationRequest, folder: Path) -> bool:
    if not (folder / METADATA_FILE).is_file():
        return False
    request.check_same(read_metadata(folder).extra.get(_KEY), folder)
    return True


def _prepare_parts(request: SimulationRequest, folder: Path) -> None:
    """Writes the request beside the parts, or checks that existing parts belong to the same request."""
    path = request_path(folder)
    if path.is_file():
        request.check_same(json.loads(path.read_text(encoding="utf-8")), folder)
        return
    foreign = [f"{split}.h5" for split in SPLITS if (folder / f"{split}.h5").exists()]
    if foreign:
        raise DataError(f"{folder}: {', '.join(foreign)} exists already and was not simulated; choose another folder.")
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(request.to_dict(), indent=1), encoding="utf-8")


def _remove_stale_files(folder: Path) -> None:
    """Removes files that killed processes left incomplete; the lock guarantees that no other process is writing."""
    for stale in [*temporary_files(folder), *temporary_files(folder / PARTS)]:
        stale.unlink(missing_ok=True)


def _missing(folder: Path, wanted: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Those of the trajectories that are neither in their split's file nor in a part."""
    return [(s, i) for s, i in wanted if not (folder / f"{s}.h5").is_file() and not part_path(folder, s, i).is_file()]


def _copy_parts(request: SimulationRequest, folder: Path, known: Path) -> None:
    """Writes the missing parts of trajectories that another dataset has."""
    files = {split: known / f"{split}.h5" for split in request.splits}
    splits = {split: Split(path) for split, path in files.items() if path.is_file()}
    missing = [(s, i) for s, i in _missing(folder, request.trajectories) if s in splits and i < len(splits[s])]
    if not missing:
        return
    _log.info("Copying %d trajectories of %s from %s.", len(missing), request.preset.name, known)
    with progress_bar(f"Copying trajectories of {known.name}", len(missing)) as advance:
        for split, index in missing:
            write_part(part_path(folder, split, index), splits[split].read(index))
            advance()


def _simulate_parts(request: SimulationRequest, folder: Path, wanted: Sequence[tuple[str, int]], workers: int) -> None:
    missing, total = _missing(folder, wanted), len(wanted)
    if not missing:
        return
    _log.info("Simulating %d of %d trajectories of %s into %s.", len(missing), total, request.preset.name, folder)
    with started_workers(request, folder, workers, len(missing)) as started:
        idle: SimpleQueue[Worker] = SimpleQueue()
        for worker in started:
            idle.put(worker)
        pool = ThreadPoolExecutor(len(started))
        try:
            with progress_bar(f"Simulating {request.preset.name}", total, total - len(missing)) as advance:
                for future in as_completed([pool.submit(_simulate_part, idle, s, i) for s, i in missing]):
                    future.result()
                    advance()
        finally:  # after Ctrl-C or a simulation that failed, too: the others need not end before it shows
            for worker in started:
                worker.stop()
            pool.shutdown(cancel_futures=True)


def _simulate_part(idle: SimpleQueue[Worker], split: str, index: int) -> None:
    worker = idle.get()
    try:
        worker.simulate(split, index)
    finally:
        idle.put(worker)


def _assemble(request: SimulationRequest, folder: Path, split: str) -> None:
    path = folder / f"{split}.h5"
    parts = [part_path(folder, split, index) for index in range(request.counts[split])]
    if not path.is_file():
        with progress_bar(f"Writing {path.name}", len(parts)) as advance:
            write_split(path, read_parts(parts, advance))
    for part in parts:
        part.unlink(missing_ok=True)


def _find_redrawn(request: SimulationRequest, folder: Path) -> dict[str, dict[str, int]]:
    """The trajectories whose first seeds were unstable, and how many were, by split and index."""
    found: dict[str, dict[str, int]] = {}
    for split in request.splits:
        stored = Split(folder / f"{split}.h5")
        for index in range(len(stored)):
            entropy, seed = request.entropy(split, index), int(stored.attributes(index)["seed"])
            draw = next(draw for draw in range(DRAWS) if seed_of_draw(entropy, draw) == seed)
            if draw:
                found.setdefault(split, {})[str(index)] = draw
    return found


def preset_metadata(preset: Preset) -> Metadata:
    """The metadata of the trajectories that a preset simulates."""
    scene = preset.scene
    return Metadata(
        bounds=scene.bounds,
        dt=scene.dt,
        dim=scene.dim,
        sequence_length=preset.frames,
        particle_types=preset.type_names,
        static_types=frozenset({BOUNDARY}),
        domain=scene.domain,
        gravity=scene.gravity,
        particle_volume=scene.particle_volume,
        densities=dict(zip(scene.materials, scene.densities, strict=True)) if scene.densities else {},
        extra={
            "default_connectivity_radius": round(1.8 * scene.particle_spacing, 6),
            "num_particles_max": preset.max_particles,
            "generator": f"nmpm {__version__}, {preset.generator}",
            "note": "Simulated by nmpm; not measured, and not anybody else's dataset.",
        },
    )
