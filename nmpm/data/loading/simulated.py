"""Endless training trajectories straight from a simulator; nothing is written to disk."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from threading import Lock

from nmpm._support.progress import progress_bar
from nmpm._support.threads import usable_cores
from nmpm.data.format import SPLITS, Trajectory
from nmpm.data.generate import preset_metadata
from nmpm.data.loading.background import Task, map_in_threads, raise_if_abandoned, run_in_thread
from nmpm.data.loading.recording import Recording, RecordingReader
from nmpm.data.seeds import simulate_first_stable
from nmpm.errors import ConfigError
from nmpm.sim import Preset

_STREAM = len(SPLITS)  # not the index of a split, so that no seed is that of a written trajectory
_CACHED_REQUESTS = 2  # the buffer in use and the next


class SimulatedRecordings:
    """The trajectories that a preset gives for a seed, simulated on request.

    Index i is always the same trajectory, so that a resumed training uses the same ones as an uninterrupted one.

    Args:
        preset: The family of scenes.
        seed: The seeds of all trajectories are derived from it.
        workers: Trajectories simulated at a time; one for each processor core when left out.
    """

    def __init__(self, preset: Preset, seed: int = 0, workers: int | None = None) -> None:
        self.preset, self.seed, self.scene = preset, seed, preset.scene
        self.workers = workers or usable_cores()
        self.reader = RecordingReader(preset_metadata(preset), self.scene)
        self._lock = Lock()
        self._requests: OrderedDict[tuple[int, ...], Task[list[Recording]]] = OrderedDict()

    def __getitem__(self, index: int) -> Recording:
        """Simulates one trajectory.

        Raises:
            ConfigError: if the simulation fails from several seeds in a row; names preset and seed.
        """
        entropy = (self.seed, _STREAM, index)
        run = simulate_first_stable(self.preset, entropy, progress=lambda _: raise_if_abandoned())
        trajectory = Trajectory(run.position, run.particle_type, run.attributes)
        return self.reader.recording(trajectory, f"{self.preset.name}, simulated trajectory {index}")

    @property
    def max_bytes(self) -> int:
        """Size of the positions of the largest trajectory that can occur."""
        return 4 * (self.preset.frames + 1) * self.preset.max_particles * self.scene.dim

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Simulates several trajectories in parallel; the results of the last two requests are cached."""
        key = tuple(indices)
        with self._lock:
            if key in self._requests and self._requests[key].failed:
                del self._requests[key]
            first = not self._requests
            if key not in self._requests:
                self._requests[key] = run_in_thread(self._simulate_first if first else self._simulate, key)
            while len(self._requests) > _CACHED_REQUESTS:
                self._requests.popitem(last=False)
            request = self._requests[key]
        return request.result()

    def require_frames(self, frames: int, purpose: str) -> None:
        """Raises an error if the trajectories are too short.

        Raises:
            ConfigError: if they have fewer frames.
        """
        if self.preset.frames + 1 < frames:
            raise ConfigError(
                f"{self.preset.name}: its trajectories have {self.preset.frames + 1} frames, {purpose} needs {frames}."
                " Shorten the horizon (frames per bundle x bundles unrolled) or simulate more frames."
            )

    def close(self) -> None:
        """Stops the simulations that are running and forgets the cached ones."""
        with self._lock:
            requests = list(self._requests.values())
            self._requests.clear()
        for request in requests:
            request.cancel()

    def _simulate(self, indices: Sequence[int]) -> list[Recording]:
        return map_in_threads(self.__getitem__, indices, self.workers)

    def _simulate_first(self, indices: Sequence[int]) -> list[Recording]:
        """Simulates with a progress bar, as training waits for the first trajectories."""
        what = f"Simulating the first {len(indices)} trajectories of {self.preset.name}"
        with progress_bar(what, len(indices)) as advance:

            def simulate(index: int) -> Recording:
                recording = self[index]
                advance()
                return recording

            return map_in_threads(simulate, indices, self.workers)
