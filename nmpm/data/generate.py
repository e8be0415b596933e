"""Simulates datasets; resumes after an interruption; gives the same bytes for any number of workers.

An unfinished folder contains `.parts`, with the request and a file for each finished trajectory. When all parts of a
split are there they are assembled into its HDF5 file; `metadata.json` is written last and marks the dataset as
complete. Files are written atomically, so that a repeated call continues where the last one stopped.

Shards are processes that write different parts to the same folder at the same time. Each holds a lock of its own; who
holds the folder's lock, to simulate the rest and to assemble, waits for theirs.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np

from nmpm._support.atomic import atomic_write, lock_folder, temporary_files
from nmpm._support.bounded_files import NPZ_ERRORS
from nmpm._support.progress import progress_bar
from nmpm._support.threads import map_ranges, usable_cores
from nmpm._support.threads import split as split_ranges
from nmpm._support.version import __version__
from nmpm.data.format import METADATA_FILE, Metadata, Split, Trajectory, read_metadata, write_metadata, write_split
from nmpm.data.metadata import scene_metadata
from nmpm.data.simulation import DRAWS, Shard, SimulationRequest, seed_of_draw, simulate_all
from nmpm.data.split_files import SPLITS
from nmpm.data.statistics import MotionStatistics
from nmpm.errors import DataError
from nmpm.sim import Preset, SimulatedTrajectory
from nmpm.sim.preset import BOUNDARY

_PARTS, _REQUEST = ".parts", "request.json"
_KEY = "simulation"

_log = logging.getLogger(__name__)


def generate(
    preset: Preset,
    folder: Path,
    counts: Mapping[str, int],
    seed: int = 0,
    workers: int | None = None,
    copy_from: Path | None = None,
) -> None:
    """Simulates a dataset into a folder, unless it is complete already.

    Several processes may call this for the same folder: the first one simulates, the others wait for it.

    Args:
        preset: The family of scenes.
        folder: The dataset's folder; created if missing.
        counts: As for `SimulationRequest`.
        seed: Likewise.
        workers: Trajectories simulated at a time; one per processor core when left out. Where there is much to
            simulate, each is a process, of about 200 MB.
        copy_from: A complete dataset of the same preset and seed, whose trajectories are copied.

    Raises:
        ConfigError: if preset or counts are invalid.
        DataError: if the folder has other data than requested, or cannot be written, or `copy_from` cannot be read.
    """
    request, folder = SimulationRequest(preset, counts, seed), Path(folder)
    if _is_complete(request, folder):  # without the lock, which needs a writable folder
        return
    with _explained_write_errors(folder), lock_folder(folder):
        if _is_complete(request, folder):
            return
        _prepare_parts(request, folder)
        for shard in sorted((folder / _PARTS).glob("shard-*")):
            with lock_folder(shard):  # waits for the shard that is being simulated
                pass
        for stale in temporary_files(folder):
            stale.unlink(missing_ok=True)
        if copy_from is not None:
            _copy_parts(request, folder, copy_from)
        _simulate_parts(request, folder, request.trajectories, workers)
        for split in request.splits:
            _assemble(request, folder, split)
        _write_metadata(request, folder)
        shutil.rmtree(folder / _PARTS, ignore_errors=True)


def generate_shard(
    preset: Preset,
    folder: Path,
    counts: Mapping[str, int],
    shard: Shard,
    seed: int = 0,
    workers: int | None = None,
) -> int:
    """Simulates a shard of a dataset; the one that finishes last completes it, with the bytes that `generate` writes.

    Shards may run at the same time in the same folder. Other arguments and errors are as for `generate`.

    Returns:
        Number of trajectories that other shards have yet to simulate; 0 if the dataset is complete.
    """
    request, folder = SimulationRequest(preset, counts, seed), Path(folder)
    if _is_complete(request, folder):
        return 0
    with _explained_write_errors(folder), ExitStack() as own_lock:
        with lock_folder(folder):
            if _is_complete(request, folder):
                return 0
            _prepare_parts(request, folder)
            own_lock.enter_context(lock_folder(folder / _PARTS / f"shard-{shard.index}-of-{shard.count}"))
        _simulate_parts(request, folder, shard.select(request.trajectories), workers)
        missing = len(_missing(folder, request.trajectories))
    if missing == 0:
        generate(preset, folder, counts, seed, workers)
    return missing


@contextmanager
def _explained_write_errors(folder: Path) -> Iterator[None]:
    """Raises a DataError, which says how to continue, where writing to the folder fails."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error}). Finished trajectories are kept; free space or correct the"
            " permissions, and repeat the call to continue."
        ) from error


def _is_complete(request: SimulationRequest, folder: Path) -> bool:
    if not (folder / METADATA_FILE).is_file():
        return False
    request.check_same(read_metadata(folder).extra.get(_KEY), folder)
    return True


def _prepare_parts(request: SimulationRequest, folder: Path) -> None:
    """Writes the request beside the parts, or checks that existing parts belong to the same request."""
    path = folder / _PARTS / _REQUEST
    if path.is_file():
        request.check_same(json.loads(path.read_text(encoding="utf-8")), folder)
        return
    foreign = [f"{split}.h5" for split in SPLITS if (folder / f"{split}.h5").exists()]
    if foreign:
        raise DataError(f"{folder}: {', '.join(foreign)} exists already and was not simulated; choose another folder.")
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(request.to_dict(), indent=1), encoding="utf-8")


def _part_path(folder: Path, split: str, index: int) -> Path:
    return folder / _PARTS / f"{split}-{index:05d}.npz"


def _write_part(path: Path, run: SimulatedTrajectory | Trajectory) -> None:
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, position=run.position, particle_type=run.particle_type, **run.attributes)


def _missing(folder: Path, wanted: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Trajectories still to simulate."""
    return [(s, i) for s, i in wanted if not (folder / f"{s}.h5").is_file() and not _part_path(folder, s, i).is_file()]


def _copy_parts(request: SimulationRequest, folder: Path, source: Path) -> None:
    """Writes the missing parts of trajectories that another dataset has."""
    files = {split: source / f"{split}.h5" for split in request.splits}
    splits = {split: Split(path) for split, path in files.items() if path.is_file()}
    missing = [(s, i) for s, i in _missing(folder, request.trajectories) if s in splits and i < len(splits[s])]
    if not missing:
        return
    _log.info("Copying %d trajectories of %s from %s.", len(missing), request.preset.name, source)
    with progress_bar(f"Copying trajectories of {source.name}", len(missing)) as advance:
        for split, index in missing:
            _write_part(_part_path(folder, split, index), splits[split].read(index))
            advance()


def _simulate_parts(
    request: SimulationRequest, folder: Path, wanted: Sequence[tuple[str, int]], workers: int | None
) -> None:
    missing, total = _missing(folder, wanted), len(wanted)
    if not missing:
        return
    _log.info("Simulating %d of %d trajectories of %s into %s.", len(missing), total, request.preset.name, folder)
    entropies = [request.entropy(split, index) for split, index in missing]
    with (
        progress_bar(f"Simulating {request.preset.name}", total, total - len(missing)) as advance,
        closing(simulate_all(request.preset, entropies, workers or usable_cores())) as runs,
    ):
        for number, run in runs:
            _write_part(_part_path(folder, *missing[number]), run)
            advance()


def _assemble(request: SimulationRequest, folder: Path, split: str) -> None:
    path = folder / f"{split}.h5"
    parts = [_part_path(folder, split, index) for index in range(request.counts[split])]
    if not path.is_file():
        with progress_bar(f"Writing {path.name}", len(parts)) as advance:
            write_split(path, _read_parts(parts, advance))
    for part in parts:
        part.unlink(missing_ok=True)


def _read_parts(paths: Iterable[Path], advance: Callable[[], object]) -> Iterator[Trajectory]:
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as arrays:
                attributes = {k: arrays[k][()] for k in sorted(set(arrays) - {"position", "particle_type"})}
                yield Trajectory(arrays["position"], arrays["particle_type"], attributes)
        except NPZ_ERRORS as error:
            raise DataError(
                f"{path}: damaged ({error}); delete it and repeat the call, which simulates it again."
            ) from error
        advance()


def _write_metadata(request: SimulationRequest, folder: Path) -> None:
    metadata = preset_metadata(request.preset)
    first, statistics = Split(folder / f"{request.splits[0]}.h5"), MotionStatistics(metadata)
    trajectories = split_ranges(len(first), 1)
    for moments in map_ranges(lambda index, _: statistics.moments(first.read(index)), trajectories, usable_cores()):
        statistics.add_moments(moments)
    redrawn: dict[str, dict[str, int]] = {}  # how many seeds of a trajectory were unstable, where some were
    for split in request.splits:
        stored = Split(folder / f"{split}.h5")
        for index in range(len(stored)):
            entropy, seed = request.entropy(split, index), int(stored.attributes(index)["seed"])
            draw = next(draw for draw in range(DRAWS) if seed_of_draw(entropy, draw) == seed)
            if draw:
                redrawn.setdefault(split, {})[str(index)] = draw
    simulation = request.to_dict() | ({"redrawn": redrawn} if redrawn else {})
    extra = metadata.extra | statistics.result() | {_KEY: simulation}
    write_metadata(folder, dataclasses.replace(metadata, extra=extra))


def preset_metadata(preset: Preset) -> Metadata:
    """The metadata of the trajectories that a preset simulates."""
    scene = preset.scene
    return dataclasses.replace(
        scene_metadata(scene, preset.type_names, BOUNDARY),
        sequence_length=preset.frames,
        extra={
            "default_connectivity_radius": round(1.8 * scene.particle_spacing, 6),
            "num_particles_max": preset.max_particles,
            "generator": f"nmpm {__version__}, {preset.generator}",
            "note": "Simulated by nmpm; not measured, and not anybody else's dataset.",
        },
    )
