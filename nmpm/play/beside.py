"""The simulator beside the emulator, in a process of its own, from the state that is shown."""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections import deque
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from nmpm.errors import UnstableError
from nmpm.play.simulating import Simulated, simulate_for
from nmpm.scene import Scene
from nmpm.sim import Preset
from nmpm.zoo.fallback import fitting_preset, initial_state

if TYPE_CHECKING:
    from nmpm.play.world import World

_TIMED_FRAMES = 40


class SimulatorBeside:
    """Simulates what an emulator predicts, as fast as it can, but not faster than it is shown.

    Args:
        scene: The model's.
        preset: Of the model's scenes.
    """

    def __init__(self, scene: Scene, preset: Preset) -> None:
        self._scene, self._preset, self._due = scene, preset, 0
        self._times: deque[float] = deque(maxlen=_TIMED_FRAMES)
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=simulate_for, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()
        self._run = 0

    @property
    def frame_seconds(self) -> float:
        """Median time of the last frames; 0 before the first."""
        return sorted(self._times)[len(self._times) // 2] if self._times else 0.0

    def start(self, world: World) -> None:
        """Start anew from what is shown, at rest density and without strain.

        Raises:
            ConfigError: if the simulator has no such obstacles.
        """
        state, spacing = world.now(), self._scene.particle_spacing
        bodies = [body.particles(spacing).to(world.static) for body in world.bodies.values()]
        obstacle = torch.cat([world.static[0], *bodies])[None]
        state = dataclasses.replace(
            state, obstacle=obstacle, obstacle_mask=torch.ones_like(obstacle[..., 0]).bool(), obstacle_share=None
        )
        preset = fitting_preset(self._scene, state, self._preset)
        start, self._order = initial_state(self._scene, state, preset)
        self._there, self._count = state.mask[0].nonzero()[:, 0].numpy(), world.count
        self._run, self._due = self._run + 1, 0
        self._pipe.send((self._run, preset, start))

    def advance(self, frames: int) -> tuple[int, NDArray[np.float32]] | None:
        """The last frame that is there, of those that may be shown now, and its positions (N, D); None for no new one.

        Raises:
            UnstableError: if the simulation has become unstable, or its process has ended.
        """
        self._due += frames
        shown = None
        while self._due > 0 and self._pipe.poll():
            try:
                made: Simulated = self._pipe.recv()
            except (EOFError, OSError) as error:
                raise UnstableError("the simulator's process has ended") from error
            if made.run != self._run:
                continue
            if made.problem:
                raise UnstableError(f"the simulator: {made.problem}")
            self._due -= 1
            self._times.append(made.seconds)
            shown = made.frame, self._in_order(made.position)
        self._due = min(self._due, frames)
        return shown

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.terminate()
        self._process.join()

    def _in_order(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Simulated positions in the order of the emulator's particles."""
        ordered = np.full((self._count, position.shape[1]), np.nan, np.float32)
        ordered[self._there[self._order]] = position
        return ordered
