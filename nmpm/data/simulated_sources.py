"""Sources of embedded datasets, and of endless trajectories straight from a simulator.

Apart from `nmpm.data.catalog`, whose callers that only simulate need no torch.
"""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from threading import Lock
from typing import Any

from nmpm._support.progress import progress_bar
from nmpm._support.threads import Task, raise_if_abandoned, usable_cores
from nmpm.data.batches import EndlessWindowPlan, RecordingProvider, WindowPlan
from nmpm.data.catalog import describe, ensure, simulation_request
from nmpm.data.format import SPLITS, Trajectory
from nmpm.data.recordings import RecordingReader
from nmpm.data.simulation import preset_metadata, simulate_all
from nmpm.data.sources import DataSource
from nmpm.data.windows import Recording
from nmpm.errors import ConfigError
from nmpm.scene import Reading, Scene
from nmpm.sim import Preset

_STREAM = len(SPLITS)  # not the index of a split, so that no seed is that of a written trajectory
_CACHED_REQUESTS = 2  # the buffer in use and the next
_GENERATE = frozenset(inspect.signature(ensure).parameters) - {"name"}


@dataclass(frozen=True)
class EmbeddedSource(DataSource):
    """A dataset of `nmpm.data.catalog`, simulated on first use; `generate` are keyword arguments of `ensure`."""

    name: str
    generate: dict[str, Any] = field(default_factory=dict)

    @property
    def description(self) -> str:
        return f"{self.name}, simulated by nmpm"

    @cached_property
    def folder(self) -> Path:
        return ensure(self.name, **self._check_options())

    @property
    def scene(self) -> Scene:
        return simulation_request(self.name).preset.scene

    def _check_options(self) -> dict[str, Any]:
        unknown = sorted(set(self.generate) - _GENERATE)
        if unknown:
            mend = (
                " Trajectories per split belong under counts: generate: {counts: {train: 4, valid: 1, test: 1}}."
                if set(unknown) & set(SPLITS)
                else ""
            )
            raise ConfigError(
                f"generate = {self.generate}: {', '.join(map(repr, unknown))} is not an option; there are"
                f" {', '.join(sorted(_GENERATE))}.{mend}"
            )
        return self.generate


@dataclass(frozen=True)
class SimulatedSource(EmbeddedSource):
    """Trains on new trajectories from the simulator, each in one buffer only; evaluates on the embedded dataset."""

    @property
    def description(self) -> str:
        return f"{self.name}, simulated by nmpm while training"

    @cached_property
    def folder(self) -> Path:
        options = self._check_options()
        counts = dict(options.get("counts") or describe(self.name).counts)
        return ensure(self.name, **(options | {"counts": counts | {"train": 0}}))

    @cached_property
    def training_recordings(self) -> SimulatedRecordings:
        """The trajectories to train on: one provider, whose buffers calibration and training share."""
        options = {key: value for key, value in self._check_options().items() if key not in ("counts", "workers")}
        request = simulation_request(self.name, **options)
        return SimulatedRecordings(request.preset, request.seed, self.generate.get("workers"))

    def training_data(self, length: int, reading: Reading, **plan: Any) -> tuple[RecordingProvider, WindowPlan]:
        length = reading.data_frames(length)
        self.training_recordings.reading = reading
        frames = self.training_recordings.preset.frames + 1
        if frames < length:
            raise ConfigError(
                f"{self.name}: its trajectories have {frames} frames, a training window of {length - 2} frames to"
                f" predict needs {length}. Shorten the horizon (frames per bundle x bundles unrolled) or simulate more"
                " frames."
            )
        plan["frames"] = (frames,) * plan["buffer_size"]
        return self.training_recordings, EndlessWindowPlan(length=length, **plan)


class SimulatedRecordings:
    """Endless trajectories that a preset gives for a seed, simulated on request; nothing is written to disk.

    Index i is always the same trajectory, so that a resumed training uses the same ones as an uninterrupted one. So
    many are simulated at a time as there are workers, by default processor cores.
    """

    def __init__(self, preset: Preset, seed: int = 0, workers: int | None = None) -> None:
        self.preset, self.seed = preset, seed
        self.workers = workers or usable_cores()
        self.reader = RecordingReader(preset_metadata(preset), Reading(preset.scene))
        self._lock = Lock()
        self._requests: OrderedDict[tuple[int, ...], Task[list[Recording]]] = OrderedDict()

    @property
    def reading(self) -> Reading:
        """How the trajectories are read."""
        return self.reader.reading

    @reading.setter
    def reading(self, reading: Reading) -> None:
        if reading != self.reading:
            self.close()
            self.reader = RecordingReader(self.reader.metadata, reading)

    @property
    def max_bytes(self) -> int:
        """Size of the positions of the largest trajectory that can occur."""
        return 4 * (self.preset.frames + 1) * self.preset.max_particles * self.preset.scene.dim

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Simulates several trajectories, see `simulate_all`; the results of the last two requests are cached."""
        key = tuple(indices)
        with self._lock:
            if key in self._requests and self._requests[key].failed:
                del self._requests[key]
            if key not in self._requests:
                self._requests[key] = Task(partial(self._simulate, key, first=not self._requests))
            while len(self._requests) > _CACHED_REQUESTS:
                self._requests.popitem(last=False)
            request = self._requests[key]
        return request.result()

    def close(self) -> None:
        """Stops the simulations that are running and forgets the cached ones."""
        with self._lock:
            requests = list(self._requests.values())
            self._requests.clear()
        for request in requests:
            request.cancel()

    def _simulate(self, indices: Sequence[int], first: bool) -> list[Recording]:
        """Simulates, with a progress bar if these are the `first` trajectories, which training waits for."""
        entropies = [(self.seed, _STREAM, index) for index in indices]
        recordings: dict[int, Recording] = {}
        what = f"Simulating the first {len(indices)} trajectories of {self.preset.name}"
        with (
            progress_bar(what, len(indices)) if first else nullcontext(lambda: None) as advance,
            closing(simulate_all(self.preset, entropies, self.workers, raise_if_abandoned)) as runs,
        ):
            for number, run in runs:
                trajectory = Trajectory(run.position, run.particle_type, run.attributes)
                where = f"{self.preset.name}, simulated trajectory {indices[number]}"
                recordings[number] = self.reader.recording(trajectory, where)
                advance()
        return [recordings[number] for number in range(len(indices))]
