"""The simulator beside the emulator, in a process of its own, from the state that is shown."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from fractions import Fraction
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from nmpm.errors import ConfigError, UnstableError
from nmpm.obstacles import Disc
from nmpm.particles import Particles
from nmpm.play.simulating import Simulated, simulate_for
from nmpm.scene import Scene
from nmpm.sim import InitialState, Preset
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.sim.state import Array
from nmpm.zoo.scenes import SAME, scene_differences

if TYPE_CHECKING:
    from nmpm.play.world import World

_TIMED_FRAMES = 40
_LONGEST_RATIO = 64
"""Largest denominator of the ratio between the frames of model and preset."""


class SimulatorBeside:
    """Simulates what an emulator predicts, as fast as it can, but not faster than it is shown.

    Args:
        scene: The model's.
        preset: Of the model's scenes.
    """

    def __init__(self, scene: Scene, preset: Preset) -> None:
        self._scene, self._preset, self._due = scene, preset, 0
        self._times: deque[float] = deque(maxlen=_TIMED_FRAMES)
        self._run, self._frame, self._is_warm = 0, 0, False
        self._process: BaseProcess | None = None
        self._sender, self._sending = ThreadPoolExecutor(1), Future[None]()
        self._to_send: tuple[int, Preset, InitialState] | None = None
        self._sending.set_result(None)

    @property
    def frame_seconds(self) -> float:
        """Median time of the last frames; 0 before the first."""
        return sorted(self._times)[len(self._times) // 2] if self._times else 0.0

    def start(self, world: World, frame: int) -> None:
        """Start anew from what is shown, a frame of the emulator's, at rest density and without strain.

        Raises:
            ConfigError: if the simulator has no such obstacles.
        """
        state, spacing = world.now(), self._scene.particle_spacing
        bodies = [body.particles(spacing).to(world.static) for body in world.bodies.values()]
        obstacle = torch.cat([world.static[0], *bodies])[None]
        state = dataclasses.replace(
            state, obstacle=obstacle, obstacle_mask=torch.ones_like(obstacle[..., 0]).bool(), obstacle_share=None
        )
        try:
            preset = fitting_preset(self._scene, state, self._preset)
        except ConfigError as error:
            if any(isinstance(body, Disc) for body in world.bodies.values()):
                raise ConfigError("the simulator has no discs: take them away, then start it again (B)") from error
            raise
        start, self._order = initial_state(self._scene, state, preset)
        self._there, self._count = state.mask[0].nonzero()[:, 0].numpy(), world.count
        self._run, self._due, self._frame = self._run + 1, 0, frame
        self._to_send = self._run, preset, start
        if self._process is None:
            self._open()
        self._keep_sending()

    def _open(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=simulate_for, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def _keep_sending(self) -> None:
        """Send the last start by a thread of its own, as the pipe may be full both ways."""
        if self._to_send is not None and self._sending.done():
            self._sending = self._sender.submit(self._send)

    def _send(self) -> None:
        with suppress(OSError):  # the process has ended, which `advance` says
            while self._to_send is not None:
                start, self._to_send = self._to_send, None
                self._pipe.send(start)

    def advance(self, world: World, frame: int, frames: int) -> tuple[int, NDArray[np.float32]] | None:
        """Up to so many frames more, as far as they are there: the last one's number and positions (N, D), or None.

        What is shown, a frame of the emulator's, is started from once the process is ready: both begin together.

        Raises:
            ConfigError: as `start`.
            UnstableError: if the simulation has become unstable, or its process has ended.
        """
        self._keep_sending()
        self._due, shown = self._due + frames, None
        while self._due > 0 and self._pipe.poll():
            made = self._receive()
            if made.run != self._run:
                continue
            if made.problem:
                raise UnstableError(f"the simulator: {made.problem}")
            if not self._is_warm:
                self._is_warm = True
                self.start(world, frame)
                return None
            self._due -= 1
            self._times.append(made.seconds)
            shown = self._frame + made.frame, self._in_order(made.position)
        self._due = min(self._due, frames)
        return shown

    def _receive(self) -> Simulated:
        try:
            made: Simulated = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise UnstableError("the simulator's process has ended") from error
        return made

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()
            self._sender.shutdown()
            self._pipe.close()

    def _in_order(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Simulated positions in the order of the emulator's particles."""
        ordered = np.full((self._count, position.shape[1]), np.nan, np.float32)
        ordered[self._there[self._order]] = position
        return ordered


def fitting_preset(scene: Scene, state: Particles, preset: Preset) -> Preset:
    """The preset with the frames of a model's scene, from whose state it shall go on.

    Raises:
        ConfigError: naming what differs: a material, the bounds, the volume of particles, what the simulator lacks; or
            obstacles that cannot be told from their particles.
    """
    differences = dict.fromkeys(scene_differences(scene, preset), True) | {
        "its particles are all of one size": state.volume is not None and bool((state.volume[state.mask] != 1).any()),
        f"it has no {', '.join(scene.fields)}": bool(scene.fields),
        "its obstacles do not move": scene.moving_obstacles,
        "it simulates only states that it has drawn": isinstance(preset, MpmMixture),
    }
    for difference, differs in differences.items():
        if differs:
            raise ConfigError(f"the preset {preset.name} is of other scenes than the model's: {difference}.")
    for index in range(len(state.position)):
        preset.obstacles_from(_obstacle(state, index))
    ratio = scene.dt / preset.frame_dt
    if math.isclose(ratio, 1.0, rel_tol=SAME):
        return preset
    return preset.with_stride(Fraction(ratio).limit_denominator(_LONGEST_RATIO))


def _obstacle(state: Particles, index: int) -> Array:
    """(M, D) obstacle particles of a scene of the batch."""
    return state.obstacle[index, state.obstacle_mask[index]].cpu().double().numpy()


def initial_state(scene: Scene, state: Particles, preset: Preset) -> tuple[InitialState, NDArray[np.int64]]:
    """What the simulator starts from, and the state's particles in the simulator's order, by material."""
    real, names = state.mask[0].cpu().numpy(), preset.scene.materials
    kinds = np.array([names.index(name) for name in scene.materials])[state.material[0].cpu().numpy()[real]]
    order = np.argsort(kinds, kind="stable")
    position, velocity = (
        values[0].detach().cpu().double().numpy()[real][order] for values in (state.position, state.velocity)
    )
    low, high = np.array(preset.reach).T
    gravity = tuple((state.gravity[0].double() / scene.dt**2).tolist()) if scene.gravity_known else None
    counts = tuple(np.bincount(kinds, minlength=len(names)).tolist())
    obstacles = preset.obstacles_from(_obstacle(state, 0))
    # (beyond the simulator's walls by rounding alone)
    return InitialState(np.clip(position, low, high), velocity / scene.dt, gravity, counts, obstacles), order
