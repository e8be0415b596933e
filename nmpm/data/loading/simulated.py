"""Trajectories fresh from the simulator: endless, and never written."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future
from threading import Lock

from nmpm.data.format import SPLITS, Trajectory
from nmpm.data.generate import derive_seed, preset_metadata
from nmpm.data.loading.background import map_in_threads, raise_if_abandoned, run_in_thread
from nmpm.data.loading.recording import Recording, RecordingReader
from nmpm.data.progress import progress_bar
from nmpm.errors import ConfigError
from nmpm.sim import Preset

_STREAM = len(SPLITS)  # no split's number, so that no seed is that of a written trajectory
_REMEMBERED = 2  # requests: the buffer in use and the next


class SimulatedRecordings:
    """The trajectories that a preset gives for a seed, simulated when asked for.

    Number i is always the same one, so that training that stopped goes on with the trajectories it would have seen.

    Args:
        preset: What to simulate.
        seed: From which the seed of every trajectory is derived.
        workers: Trajectories simulated at a time; one for each processor core when left out.
    """

    def __init__(self, preset: Preset, seed: int = 0, workers: int | None = None) -> None:
        self.preset, self.seed, self.scene = preset, seed, preset.scene
        self.workers = workers or os.cpu_count() or 1
        self.reader = RecordingReader(preset_metadata(preset), self.scene)
        self._lock = Lock()
        self._requests: OrderedDict[tuple[int, ...], Future[list[Recording]]] = OrderedDict()

    def __getitem__(self, index: int) -> Recording:
        """Simulates one trajectory.

        Raises:
            ConfigError: if the simulation fails; names preset and seed.
        """
        made = self.preset.simulate(derive_seed(self.seed, _STREAM, index), progress=lambda _: raise_if_abandoned())
        trajectory = Trajectory(made.position, made.particle_type, made.attributes)
        return self.reader.recording(trajectory, f"{self.preset.name}, simulated trajectory {index}")

    @property
    def max_bytes(self) -> int:
        """Size of the positions of the largest trajectory that may come."""
        return 4 * (self.preset.frames + 1) * self.preset.most_particles * self.scene.dim

    def load(self, indices: Sequence[int]) -> list[Recording]:
        """Simulates several trajectories side by side; those asked for last and next to last are still at hand."""
        key = tuple(indices)
        with self._lock:
            first = not self._requests
            if key not in self._requests:
                self._requests[key] = run_in_thread(self._simulate_shown if first else self._simulate, key)
            while len(self._requests) > _REMEMBERED:
                self._requests.popitem(last=False)
            request = self._requests[key]
        return request.result()

    def require_frames(self, frames: int, purpose: str) -> None:
        """Makes sure that the trajectories are long enough.

        Raises:
            ConfigError: if they are shorter.
        """
        if self.preset.frames + 1 < frames:
            raise ConfigError(
                f"{self.preset.name}: its trajectories have {self.preset.frames + 1} frames, {purpose} needs {frames}."
                " Shorten the horizon (frames per bundle x bundles unrolled) or simulate more frames."
            )

    def _simulate(self, indices: Sequence[int]) -> list[Recording]:
        return map_in_threads(self.__getitem__, indices, self.workers)

    def _simulate_shown(self, indices: Sequence[int]) -> list[Recording]:
        """With a progress bar: training waits for the first ones."""
        with progress_bar(
            f"Simulating the first {len(indices)} trajectories of {self.preset.name}", len(indices)
        ) as advance:

            def simulate(index: int) -> Recording:
                made = self[index]
                advance()
                return made

            return map_in_threads(simulate, indices, self.workers)
