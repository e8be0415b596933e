"""The scene that is played: particles, bodies and gravity at the frame that is shown, and how they go on.

A bundle of frames is predicted at once and shown frame by frame; while its second half is shown, a thread predicts the
next one. Whatever changes the scene drops the rest of the bundle and the next one: a new one starts from the frame that
is shown, so that a change is seen in the next picture.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nmpm.emulator import Emulator
from nmpm.emulator.bodies import sample_bodies
from nmpm.emulator.bundle import Bundle
from nmpm.emulator.prescribed import without_escaped
from nmpm.emulator.rollouts import unroll
from nmpm.errors import ConfigError
from nmpm.obstacles import Body, Ramp
from nmpm.particles import Particles
from nmpm.sim import Preset, SimulatedRamp
from nmpm.sim.mpm.mixture import MpmMixture
from nmpm.zoo.scenes import training_preset

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained

ROW = 512
"""The number of particles is padded to multiples of it, so that shapes repeat."""
_ENDLESS = 2**40
_TIMED_CALLS = 40


class World:
    """A scene that is played.

    Args:
        emulator: What predicts it.
        particles: Its first frame (B = 1), with the obstacles that stay where they are.
        bodies: Further obstacles, which may be moved.
        thread: One thread, in which it predicts.

    Attributes:
        bodies: Obstacles that may be moved, by id.
        count: Particles so far, those that have left through open axes included.
        static: (1, M, D) obstacles that stay, in domain length.
    """

    def __init__(self, emulator: Emulator, particles: Particles, bodies: Sequence[Body], thread: Executor) -> None:
        self.emulator, self.static, self._thread = emulator, particles.obstacle, thread
        self.bodies: dict[int, Body] = dict(enumerate(bodies))
        self.count = particles.position.shape[1]
        self._times: deque[float] = deque(maxlen=_TIMED_CALLS)
        self._samples: dict[int, tuple[Body, Tensor, Tensor]] = {}
        self._restart(self._among(particles, self.bodies))

    @property
    def position(self) -> Tensor:
        """(N, D) positions at the frame that is shown, in domain length; NaN where a particle has left."""
        there = self._state.mask[0, : self.count, None]
        return torch.where(there, self._path[self._index, : self.count], torch.nan)

    @property
    def material(self) -> Tensor:
        """(N,) indices into the scene's materials."""
        return self._state.material[0, : self.count]

    @property
    def gravity(self) -> list[float]:
        """(D,) in length per second squared."""
        numbers: list[float] = (self._state.gravity[0].double() / self.emulator.scene.dt**2).tolist()
        return numbers

    @property
    def call_seconds(self) -> float:
        """Median time of the last calls, a bundle each; 0 before the first."""
        return sorted(self._times)[len(self._times) // 2] if self._times else 0.0

    def advance(self) -> None:
        """Go on by a frame."""
        if self._index + 1 == len(self._path):
            self._begin_next()
        self._index += 1
        if 2 * self._index >= len(self._path):
            self._coming()

    def now(self) -> Particles:
        """The state at the frame that is shown, padded."""
        if not self._index:
            return self._state
        position, before = self._path[self._index], self._path[self._index - 1]
        there = self._state.mask[0] & position.isfinite().all(-1)
        moved = self._state.with_motion(position[None].nan_to_num(), (position - before)[None].nan_to_num())
        fields = {name: values[:, self._index - 1] for name, values in self._fields.items()}
        state = dataclasses.replace(moved, mask=there[None]).with_fields(fields)
        return without_escaped(self.emulator.scene, state)

    def add(self, position: Tensor, velocity: Tensor, material: int) -> None:
        """Put particles (K, D) into the scene, with a velocity (D,) in length per frame."""
        state, more, first = self.now(), len(position), self.count
        state = _padded(state, -(-(first + more) // ROW) * ROW)
        slots = slice(first, first + more)
        new: dict[str, Any] = {"position": position, "velocity": velocity, "material": material, "mask": True}
        if state.volume is not None:
            new["volume"] = 1.0
        changed: dict[str, Any] = {name: _with(getattr(state, name), slots, value) for name, value in new.items()}
        fields = {name: _with(v, slots, v[state.mask].mean()) for name, v in state.fields.items() if v.shape[1] > 1}
        self.count += more
        self._restart(dataclasses.replace(state, **changed).with_fields(fields))

    def set_bodies(self, bodies: Mapping[int, Body]) -> None:
        """Replace the bodies; raises ConfigError if one is outside of the domain."""
        state = self._among(self.now(), bodies)
        self.bodies = dict(bodies)
        self._restart(state)

    def set_motion(self, position: Tensor, velocity: Tensor) -> None:
        """Put the particles elsewhere: padded (1, N, D), in domain length and length per frame."""
        self._restart(self.now().with_motion(position, velocity))

    def set_gravity(self, gravity: Tensor) -> None:
        """Replace gravity, (1, D) in length per frame squared."""
        self._restart(dataclasses.replace(self.now(), gravity=gravity))

    def _among(self, state: Particles, bodies: Mapping[int, Body]) -> Particles:
        """The state among bodies, rasterised anew, and the obstacles that stay."""
        if not self.emulator.scene.obstacles:
            if bodies:
                raise ConfigError("this model was trained without obstacles and would not see them")
            return state
        samples = {number: self._sample(number, body) for number, body in bodies.items()}
        self._samples = samples
        points = torch.cat([self.static[0], *(points for _, points, _ in samples.values())])[None]
        whole = self.static.new_ones(self.static.shape[1])
        share = torch.cat([whole, *(share for *_, share in samples.values())])[None]
        mask = torch.ones_like(share, dtype=torch.bool)
        return dataclasses.replace(state, obstacle=points, obstacle_mask=mask, obstacle_share=share)

    def _sample(self, number: int, body: Body) -> tuple[Body, Tensor, Tensor]:
        """A body with points (M, D) that stand for it and their shares (M,); computed anew only if it has moved."""
        last = self._samples.get(number)
        if last is not None and last[0] is body:
            return last
        points, share = sample_bodies([[body]], self.emulator.scene, self.emulator.grid)
        return body, points.to(self.static), share[0].to(self.static)

    def _restart(self, state: Particles) -> None:
        """Start the next bundle from a state."""
        self._state, self._path, self._index = state, state.position, 0
        self._fields: Mapping[str, Tensor] = {}
        self._bundles: Iterator[Bundle] = unroll(self.emulator, state, _ENDLESS)
        self._next: Future[Bundle] | None = None

    def _begin_next(self) -> None:
        bundle = self._coming().result()
        self._path, self._index = torch.cat([self._path[-1:], bundle.position[0]]), 0
        self._fields, self._next = bundle.fields, None

    def _coming(self) -> Future[Bundle]:
        """The next bundle, which the thread predicts from now on; one that was dropped is awaited first."""
        if self._next is None:
            self._next = self._thread.submit(self._predict, self._bundles)
        return self._next

    def _predict(self, bundles: Iterator[Bundle]) -> Bundle:
        started = time.perf_counter()
        with torch.no_grad():
            bundle = next(bundles)
        self._times.append(time.perf_counter() - started)
        return bundle


def _padded(state: Particles, count: int) -> Particles:
    """The state of one scene with as much padding as makes so many particles."""
    more = count - state.position.shape[1]
    if more <= 0:
        return state

    def pad(values: Tensor) -> Tensor:
        last = values[:, -1:].expand(-1, more, *values.shape[2:])
        return torch.cat([values, torch.zeros_like(last) if values.dtype == torch.bool else last], dim=1)

    names = ("position", "velocity", "material", "mask") + (("volume",) if state.volume is not None else ())
    return dataclasses.replace(
        state,
        **{name: pad(getattr(state, name)) for name in names},
        fields={name: pad(values) if values.shape[1] > 1 else values for name, values in state.fields.items()},
    )


def _with(values: Tensor, slots: slice, new: Tensor | float) -> Tensor:
    """Values (1, N, …) with some replaced."""
    values = values.clone()
    values[0, slots] = torch.as_tensor(new).to(values)
    return values


def simulator_of(model: Pretrained) -> Preset | None:
    """The preset that simulates a model's scenes from any state; None where there is none."""
    preset = training_preset(model.scene, model.preset)
    return None if isinstance(preset, MpmMixture) else preset


def first_frame(model: Pretrained, seed: int) -> tuple[Particles, tuple[Body, ...]]:
    """The scene of a seed, as `Pretrained.example` gives it, and its ramps, if all its obstacles are, as bodies."""
    state, preset = model.example(seed).to(model.emulator.device), simulator_of(model)
    obstacles = () if preset is None else preset.draw(seed).obstacles
    ramps = [ramp for ramp in obstacles if isinstance(ramp, SimulatedRamp) and len(ramp.centre) == 2]
    if not ramps or len(ramps) < len(obstacles):
        return state, ()
    bodies = tuple(Ramp(ramp.centre, ramp.length, ramp.thickness, ramp.angle) for ramp in ramps)
    return dataclasses.replace(state, obstacle=state.obstacle[:, :0], obstacle_mask=state.obstacle_mask[:, :0]), bodies
