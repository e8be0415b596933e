"""Simulated datasets: requests, seeds, the simulation in processes, and the folders that are written.

Threads would share the interpreter's lock, which a simulator's kernels release for a tenth of a millisecond at a time:
of many threads most would wait for it. The processes are loky's, which do not import the caller's script.

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
import os
import re
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor, process_executor

from nmpm._support import __version__
from nmpm._support.atomic import atomic_write, lock_folder, temporary_files
from nmpm._support.bounded_files import NPZ_ERRORS
from nmpm._support.progress import progress_bar
from nmpm._support.threads import map_ranges, usable_cores
from nmpm._support.threads import split as split_ranges
from nmpm.data.format import (
    METADATA_FILE,
    SPLITS,
    Metadata,
    Split,
    Trajectory,
    read_metadata,
    write_metadata,
    write_split,
)
from nmpm.data.metadata import scene_metadata
from nmpm.data.statistics import MotionStatistics
from nmpm.errors import ConfigError, DataError, UnstableError
from nmpm.sim import Preset, SimulatedTrajectory, name_parts
from nmpm.sim.preset import BOUNDARY

DRAWS = 5
"""Seeds tried for one trajectory; if all are unstable, the preset is at fault."""
FRAMES_PER_PROCESS = 1000
"""Least frames for which a process is started: these take about three seconds, as does its start."""
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
"""Of a process; nothing is imported from the working directory that this process would not import from there."""
_POLL_SECONDS = 0.2

_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class SimulationRequest:
    """Everything that determines a simulated dataset.

    Raises:
        ConfigError: if a split is unknown or missing, all are empty, or a number is negative.
    """

    preset: Preset  # the family of scenes
    counts: Mapping[str, int]  # trajectories in each of the splits train, valid and test; no file is written for 0
    seed: int = 0  # the seeds of all trajectories are derived from it
    # By split and index, how many first seeds of a trajectory were unstable; known once it is simulated.
    redrawn: Mapping[str, Mapping[str, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        valid = isinstance(self.counts, Mapping) and set(self.counts) == set(SPLITS)
        valid = valid and all(isinstance(number, int) and number >= 0 for number in self.counts.values())
        if not valid or not self.splits or self.seed < 0:
            raise ConfigError(
                f"counts = {self.counts}, seed = {self.seed}: give the number of trajectories in each of "
                f"{', '.join(SPLITS)}, as in {{train: 3, valid: 1, test: 1}}, at least 1 in all; neither they nor the "
                "seed may be negative."
            )

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits that have trajectories."""
        return tuple(split for split in SPLITS if self.counts[split])

    @property
    def trajectories(self) -> list[tuple[str, int]]:
        """Split and index of every trajectory."""
        return [(split, index) for split in self.splits for index in range(self.counts[split])]

    def to_dict(self) -> dict[str, Any]:
        """The request as plain lists, strings and numbers, without what is known only once it is simulated."""
        counts = {split: self.counts[split] for split in SPLITS}
        return {"preset": self.preset.to_dict(), "counts": counts, "seed": self.seed, "revision": self.preset.revision}

    def entropy(self, split: str, index: int) -> tuple[int, int, int]:
        """The numbers that the seeds of a trajectory are derived from; independent of the counts."""
        return self.seed, SPLITS.index(split), index

    def trajectory_seed(self, split: str, index: int) -> int:
        """Seed of one trajectory."""
        return seed_of_draw(self.entropy(split, index), self.redrawn.get(split, {}).get(str(index), 0))

    def check_same(self, stored: object, folder: Path) -> None:
        """Raises a DataError if a folder's data were simulated by another request, as its JSON states it."""
        asked = json.loads(json.dumps(self.to_dict()))
        there = stored if isinstance(stored, dict) else {}
        if what := "; ".join(_differences("", there, asked)):
            raise DataError(
                f"{folder}: has other data than requested: {what}. Choose another folder, or delete this one."
            )


@dataclass(frozen=True)
class Shard:
    """Every `count`-th trajectory, from the `index`-th on, counted from 1, for the tasks of a cluster's job array.

    Raises:
        ConfigError: if the index is not from 1 to `count`.
    """

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise ConfigError(f"shard {self}: shards are counted from 1, as in 1/8, 2/8, …, 8/8.")

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Reads "I/N"; raises a ConfigError if it cannot be read, or I is not from 1 to N."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None:
            raise ConfigError(f"shard {text}: give I/N, as in 1/8, 2/8, …, 8/8.")
        return cls(int(match[1]), int(match[2]))

    def select(self, items: Sequence[T]) -> list[T]:
        """This shard's items; each item is in exactly one of the `count` shards."""
        return list(items[self.index - 1 :: self.count])


def in_short(request: Mapping[str, Any]) -> dict[str, Any]:
    """A request as `SimulationRequest.to_dict` states it, with the names of the presets that a mixture is of."""
    preset = request.get("preset")
    return {**request, "preset": name_parts(preset)} if isinstance(preset, Mapping) else dict(request)


def same_trajectories(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two requests, as `SimulationRequest.to_dict` states them, give the same trajectories, if not as many."""
    return all(one.get(key) == other.get(key) for key in ("preset", "seed", "revision"))


def same_test_scenes(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two requests, stated in full or in short, give the same test trajectories."""
    counts = [request.get("counts") for request in (one, other)]
    first, second = (count.get("test") if isinstance(count, Mapping) else None for count in counts)
    return first == second and same_trajectories(in_short(one), in_short(other))


def _differences(path: str, stored: Mapping[str, Any], asked: Mapping[str, Any]) -> Iterator[str]:
    for key, value in asked.items():
        other = stored.get(key)
        if isinstance(value, dict) and isinstance(other, dict):
            yield from _differences(f"{path}{key}.", other, value)
        elif value != other:
            yield f"{path}{key} is {other}, requested {value}"


def derive_seed(*entropy: int) -> int:
    """A seed that depends on all the numbers."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of_draw(entropy: tuple[int, ...], draw: int) -> int:
    """The seed of a trajectory, which the numbers identify, after `draw` seeds before it were unstable."""
    return derive_seed(*entropy, draw) if draw else derive_seed(*entropy)


def try_seeds(
    entropy: tuple[int, ...], simulate: Callable[[int], T], warn: Callable[[str], object] = _log.warning
) -> T:
    """The simulation from the first stable seed of a trajectory; `warn` is called for each that is not.

    Raises:
        UnstableError: if none of `DRAWS` seeds stays stable.
    """
    for draw in range(DRAWS):
        seed = seed_of_draw(entropy, draw)
        try:
            return simulate(seed)
        except UnstableError as error:
            warn(f"Another seed takes the place of {seed}, which is unstable. {error}")
            last = error
    raise UnstableError(f"{DRAWS} seeds in a row are unstable; the last: {last}") from last


def simulate_all(
    preset: Preset, entropies: Sequence[tuple[int, ...]], workers: int, check: Callable[[], object] = lambda: None
) -> Generator[tuple[int, SimulatedTrajectory], None, None]:
    """Yields the index and the trajectory of each of `entropies` as they are finished, of the first stable seed each.

    Closing the iterator ends the processes, at most `workers`, at once. They write nothing, ignore Ctrl-C, and end with
    this process however it ends. Little work is done in this process instead, one trajectory after the other.
    `check` is called several times a second; what it raises ends the simulation.

    Raises:
        UnstableError: if no seed of a trajectory stays stable.
        ConfigError: if no initial state fits into the box.
        DataError: if a process ends before its trajectory is finished.
    """
    processes = min(workers, len(entropies), len(entropies) * preset.frames // FRAMES_PER_PROCESS)
    if processes > 1:
        yield from _simulate_in_processes(preset, entropies, processes, check)
        return
    for index, entropy in enumerate(entropies):
        yield index, try_seeds(entropy, lambda seed: preset.simulate(seed, lambda _: check()))


def _simulate_in_processes(
    preset: Preset, entropies: Sequence[tuple[int, ...]], processes: int, check: Callable[[], object]
) -> Generator[tuple[int, SimulatedTrajectory], None, None]:
    resource_tracker.ensure_running()  # its start would end `_blocked_interrupts`
    executor = ProcessPoolExecutor(processes, initializer=_end_with, initargs=(os.getpid(),), env=_ENVIRONMENT)
    queue, waiting = deque(enumerate(entropies)), dict[Future[tuple[SimulatedTrajectory, list[str]]], int]()
    try:
        while queue or waiting:
            with _blocked_interrupts():
                while queue and len(waiting) <= processes:  # one more, so that no process waits
                    index, entropy = queue.popleft()
                    waiting[executor.submit(_simulate, preset, entropy)] = index
            check()
            if process_executor._global_shutdown:  # the program ends, and would wait for all that is submitted
                raise SystemExit
            for future in wait(waiting, _POLL_SECONDS, FIRST_COMPLETED).done:
                trajectory, warnings = future.result()
                for text in warnings:
                    _log.warning("%s", text)
                yield waiting.pop(future), trajectory
    except BrokenProcessPool as error:
        raise DataError(
            "A process that simulates has ended: was it killed, or is memory short? Repeat the call to continue; fewer"
            " workers take less memory."
        ) from error
    finally:
        executor.shutdown(kill_workers=True)


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile never see Ctrl-C, which reaches all processes of a terminal."""
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _end_with(owner: int) -> None:
    """Let this process end when the one that started it has ended, even by kill -9."""

    def watch() -> None:
        while os.getppid() == owner:
            time.sleep(_POLL_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _simulate(preset: Preset, entropy: tuple[int, ...]) -> tuple[SimulatedTrajectory, list[str]]:
    """A trajectory, and warnings to be logged where the user sees them."""
    warnings: list[str] = []
    return try_seeds(entropy, preset.simulate, warnings.append), warnings


_PARTS, _REQUEST = ".parts", "request.json"
_KEY = "simulation"


def generate(
    preset: Preset,
    folder: Path,
    counts: Mapping[str, int],
    seed: int = 0,
    workers: int | None = None,
    copy_from: Path | None = None,
    shard: Shard | None = None,
) -> int:
    """Simulates a dataset into a folder, unless it is complete already.

    Several processes may call this for the same folder: the first one simulates, the others wait for it. Those with
    shards simulate at the same time; the one that finishes last completes the dataset, with the same bytes.

    Args:
        preset: The family of scenes.
        folder: The dataset's folder; created if missing.
        counts: As for `SimulationRequest`.
        seed: Likewise.
        workers: Trajectories simulated at a time; one per processor core when left out. Where there is much to
            simulate, each is a process, of about 200 MB.
        copy_from: A complete dataset of the same preset and seed, whose trajectories are copied.
        shard: Which trajectories to simulate; all when left out.

    Returns:
        Number of trajectories that other shards have yet to simulate; 0 if the dataset is complete.

    Raises:
        ConfigError: if preset or counts are invalid.
        DataError: if the folder has other data than requested, or cannot be written, or `copy_from` cannot be read.
    """
    request, folder = SimulationRequest(preset, counts, seed), Path(folder)
    if _is_complete(request, folder):  # without the lock, which needs a writable folder
        return 0
    try:
        missing = 0 if shard is None else _generate_shard(request, folder, shard, workers)
        if not missing:
            _generate_rest(request, folder, workers, copy_from)
        return missing
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error}). Finished trajectories are kept; free space or correct the"
            " permissions, and repeat the call to continue."
        ) from error


def _generate_rest(request: SimulationRequest, folder: Path, workers: int | None, copy_from: Path | None) -> None:
    """Simulates what shards have not, and completes the dataset, one process at a time."""
    with lock_folder(folder):
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


def _generate_shard(request: SimulationRequest, folder: Path, shard: Shard, workers: int | None) -> int:
    """Simulates a shard while others may run; the number of trajectories that they have yet to simulate."""
    with ExitStack() as own_lock:
        with lock_folder(folder):
            if _is_complete(request, folder):
                return 0
            _prepare_parts(request, folder)
            own_lock.enter_context(lock_folder(folder / _PARTS / f"shard-{shard.index}-of-{shard.count}"))
        _simulate_parts(request, folder, shard.select(request.trajectories), workers)
        return len(_missing(folder, request.trajectories))


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
