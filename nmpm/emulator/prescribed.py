"""What a rollout is given from outside: particles that enter and leave, and obstacles that move, as recorded.

Between two bundles, particles enter that are recorded in this frame and the one before, at the recorded position and
with the recorded velocity; those that the recording no longer has leave; obstacles take their place, and the velocity
that brings them to their place at the next bundle's end. A particle that was absent is another one afterwards. After
the recording's last frame nobody enters, and obstacles stand still. Frames are counted from the start of the rollout.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

import torch
from torch import Tensor

from nmpm.emulator.bundle import RolloutContext
from nmpm.emulator.constraints import distance_beyond
from nmpm.emulator.model import Emulator
from nmpm.errors import DataError
from nmpm.particles import Batched, Particles, Window
from nmpm.scene import Scene

Predictor = Callable[[Particles, int], Tensor]
"""From a state and a number of frames to positions (B, frames, N, D)."""


@dataclass(frozen=True)
class Prescribed(Batched):
    """Recorded frames of B scenes, from the frame before a rollout's start on.

    Args:
        position: (B, F, N, D) in domain length, finite also where a particle is absent; None where nobody enters or
            leaves, as are the next two.
        present: (B, F, N) bool.
        fields: By name, (B, F, N), (B, 1, N) or (B, 1, 1), see `Window`.
        obstacle: (B, F, M, D) positions of the obstacles; None where none moves. Or (1, F, M, D), for all scenes.
    """

    position: Tensor | None = None
    present: Tensor | None = None
    fields: Mapping[str, Tensor] = field(default_factory=dict)
    obstacle: Tensor | None = None

    @classmethod
    def of(cls, window: Window) -> Self | None:
        """What rollouts of a window are given; None where all of its particles are always there, and no obstacle moves.

        Of the window's positions only those of entering particles are used. Between frames of the data, particles and
        obstacles are where the window has them, interpolated.
        """
        if window.present is None:
            return None if window.obstacle_frames is None else cls(obstacle=window.obstacle_frames)
        present = window.present & window.mask.unsqueeze(1)
        return cls(window.frames, present, window.fields, window.obstacle_frames)

    @classmethod
    def obstacles(cls, frames: Tensor) -> Self:
        """Obstacles that move: positions (F, M, D), or (B, F, M, D), from the frame of the rollout's start on.

        Raises:
            DataError: if they have another shape, or one is not finite.
        """
        if frames.dim() not in (3, 4) or not frames.numel() or not bool(frames.isfinite().all()):
            raise DataError(
                f"Positions of obstacles that move must be finite, and (F, M, D) or (B, F, M, D); these are"
                f" {tuple(frames.shape)}."
            )
        frames = frames if frames.dim() == 4 else frames.unsqueeze(0)
        return cls(obstacle=torch.cat([frames[:, :1], frames], dim=1))

    def scenes(self, chosen: slice | list[int]) -> Self:
        """As of any batch; by a list also several times the same scene, and what is the same for all scenes."""
        if isinstance(chosen, slice):
            return super().scenes(chosen)
        rows = len(chosen)
        return self.map(lambda values: values.expand(rows, *values.shape[1:]) if len(values) == 1 else values[chosen])

    def apply(self, state: Particles, frame: int, ahead: int) -> Particles:
        """The state after so many frames, a whole number of bundles of `ahead` frames, as the next starts from it."""
        return self._move_obstacles(self._exchange(state, frame, ahead), frame, ahead)

    def stays(self, state: Particles, frame: int, ahead: int) -> Tensor:
        """(B, N) bool: the particles of a state after so many frames that were there throughout the last bundle."""
        if self.present is None or self.is_over(frame):
            return state.mask
        return state.mask & self.present[:, max(0, frame + 2 - ahead) : frame + 2].all(1)

    def remaining(self, state: Particles, frame: int, ahead: int) -> Tensor:
        """(B, ahead, N) bool: the particles of a state after so many frames that are there until each of the next."""
        there = state.mask.unsqueeze(1).expand(-1, ahead, -1)
        if self.present is None:
            return there
        recorded = self.present[:, frame + 2 : frame + 2 + ahead]
        rest = there[:, recorded.shape[1] :]
        return (there & torch.cat([recorded, rest], dim=1)).int().cummin(1).values.bool()

    def _exchange(self, state: Particles, frame: int, ahead: int) -> Particles:
        if self.position is None or self.present is None or self.is_over(frame):
            return state
        position, last = self.position[:, frame + 1], self.position[:, frame]
        stays = self.stays(state, frame, ahead)
        enters = self.present[:, frame + 1] & self.present[:, frame] & ~stays
        velocity = torch.where(enters.unsqueeze(-1), position - last, 0.0)
        fields = {
            name: torch.where(stays, values, self.fields[name][:, frame + 1])
            for name, values in state.fields.items()
            if name in self.fields and self.fields[name].shape[1] > 1
        }
        return dataclasses.replace(
            state,
            position=torch.where(stays.unsqueeze(-1), state.position, position),
            velocity=torch.where(stays.unsqueeze(-1), state.velocity, velocity),
            mask=stays | enters,
            fields={**state.fields, **fields},
        )

    def _move_obstacles(self, state: Particles, frame: int, ahead: int) -> Particles:
        if self.obstacle is None:
            return state
        last = self.obstacle.shape[1] - 1
        here, there = min(frame + 1, last), min(frame + 1 + ahead, last)
        obstacle = self.obstacle[:, here].expand_as(state.obstacle)
        velocity = (self.obstacle[:, there] - self.obstacle[:, here]) / max(there - here, 1)
        return dataclasses.replace(state, obstacle=obstacle, obstacle_velocity=velocity.expand_as(obstacle))

    def is_over(self, frame: int) -> bool:
        """Whether the recording says nothing of who is there after so many frames."""
        return self.present is None or frame + 1 >= self.present.shape[1]

    def check(self, state: Particles) -> None:
        """Raise DataError if these are other particles or obstacles than the state's."""
        for name, frames, there in (
            ("particles", self.position, state.position),
            ("obstacle particles", self.obstacle, state.obstacle),
        ):
            if frames is not None and (len(frames) not in (1, len(there)) or frames.shape[2:] != there.shape[1:]):
                raise DataError(
                    f"Prescribed {name} have the shape {tuple(frames.shape)}, (scenes, frames, {name}, axes); the"
                    f" state's have {tuple(there.shape)}, (scenes, {name}, axes)."
                )


def start_of(window: Window, ahead: int) -> Particles:
    """The state at a window's second frame, its obstacles with their velocity in the first bundle of `ahead` frames."""
    prescribed = Prescribed.of(window)
    return window.initial if prescribed is None else prescribed.apply(window.initial, 0, ahead)


class Exchange:
    """What a rollout's state exchanges with the outside between two bundles.

    Args:
        emulator: In training mode nobody leaves through open axes: their errors would no longer count.
        prescribed: By a recording, if there is one; it alone says who leaves, until it is over.

    Attributes:
        varies: Whether particles may enter or leave.
    """

    def __init__(self, emulator: Emulator, prescribed: Prescribed | None) -> None:
        self._emulator, self.prescribed = emulator, prescribed
        self._leaks = "open" in emulator.scene.boundary and not emulator.training
        self.varies = self._leaks or (prescribed is not None and prescribed.present is not None)

    def start(self, particles: Particles) -> Particles:
        """The state that a rollout starts from."""
        particles = self._emulator.with_plain_padding(particles)
        if self.prescribed is None:
            return particles
        self.prescribed.check(particles)
        return self.prescribed.apply(particles, 0, self._emulator.frames)

    def stays(self, particles: Particles, frame: int) -> Tensor:
        """(B, N) bool: the particles of the state after so many frames that go on from where they are."""
        if self.prescribed is None:
            return particles.mask
        return self.prescribed.stays(particles, frame, self._emulator.frames)

    def there(self, particles: Particles, frame: int) -> Tensor:
        """(B, m, N) or (B, 1, N) bool: who is there in the bundle from a state after so many frames."""
        if self.prescribed is None:
            return particles.mask.unsqueeze(1)
        return self.prescribed.remaining(particles, frame, self._emulator.frames)

    def after(self, particles: Particles, frame: int) -> Particles:
        """The state after so many frames, for the next bundle."""
        if self.prescribed is not None:
            particles = self.prescribed.apply(particles, frame, self._emulator.frames)
        if self._leaks and (self.prescribed is None or self.prescribed.is_over(frame)):
            return without_escaped(self._emulator.scene, particles)
        return particles

    def first_context(self, particles: Particles) -> RolloutContext:
        """The context of the first call; energy is not limited where some may come in."""
        context = self._emulator.context(particles)
        if self.prescribed is None or context.budget is None:
            return context
        warnings.warn("constraints.energy does not act: particles enter or leave, or obstacles move.", stacklevel=4)
        return dataclasses.replace(context, budget=None)

    def next_context(self, context: RolloutContext, particles: Particles) -> RolloutContext:
        """The context of the call from a state, after that of the call before."""
        if self.prescribed is None or self.prescribed.obstacle is None:
            return context
        return self._emulator.surroundings(particles, None)


def without_escaped(scene: Scene, state: Particles) -> Particles:
    """The state without particles that are beyond the bounds of an open axis; they wait in the domain's middle."""
    if "open" not in scene.boundary:
        return state
    open_axes = [kind == "open" for kind in scene.boundary]
    stays = state.mask & ~(distance_beyond(state.position, scene.bounds, open_axes) > 0)
    middle = state.position.new_tensor(scene.domain).mean(1)
    moved = state.with_motion(
        torch.where(stays.unsqueeze(-1), state.position, middle), torch.where(stays.unsqueeze(-1), state.velocity, 0.0)
    )
    return dataclasses.replace(moved, mask=stays)


def predicted_particles(present: Tensor, ahead: int) -> Tensor:
    """(B, T - 2, N) bool: which recorded particles (B, T, N) a rollout in bundles of `ahead` frames predicts, and when.

    Those in its state at the bundle's start, see `Prescribed`, that are recorded in all frames since.
    """
    parts = []
    for first in range(2, present.shape[1], ahead):
        start = (present[:, first - 2] & present[:, first - 1]).unsqueeze(1)
        parts.append((start & present[:, first : first + ahead]).int().cummin(1).values.bool())
    return torch.cat(parts, dim=1) if parts else present[:, 2:]


def with_predicted(window: Window, ahead: int) -> Window:
    """The window for scores: in the frames to predict only the `predicted_particles` are present."""
    if window.present is None:
        return window
    present = torch.cat([window.present[:, :2], predicted_particles(window.present, ahead)], dim=1)
    return dataclasses.replace(window, present=present)


def predict_from_entries(predictor: Predictor, window: Window, ahead: int) -> Tensor:
    """(B, T - 2, N, D) positions of a predictor to which particles are added when they are to an emulator."""
    state, frames = window.initial, window.target.shape[1]
    path, prescribed = predictor(state, frames), Prescribed.of(window)
    if window.present is None or prescribed is None:
        return path
    for first in range(ahead, frames, ahead):
        stays, state = prescribed.stays(state, first, ahead), prescribed.apply(state, first, ahead)
        enters = state.mask & ~stays
        if bool(enters.any()):
            later = torch.where(enters[:, None, :, None], predictor(state, frames - first), path[:, first:])
            path = torch.cat([path[:, :first], later], dim=1)
    return path
