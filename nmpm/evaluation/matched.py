"""A dataset's frames, predicted by an emulator that reads it with other materials or at other frames."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nmpm.data.windows import interpolate, model_velocity
from nmpm.emulator import Emulator, Prescribed, RolloutOptions, rollout
from nmpm.emulator.prescribed import predict_from_entries
from nmpm.particles import Particles, Window
from nmpm.scene import Reading, Scene


@dataclass(frozen=True)
class MatchedPredictor:
    """Predicts the frames of a dataset through a `Reading` of it.

    Where the model makes several frames between two of the dataset, those between are left out; where it jumps over
    frames of the dataset, those are interpolated linearly. The start is the dataset's: its second frame, and the
    velocity that it has there, by which particles would have fallen freely over one frame of the model.

    Args:
        emulator: For `reading.scene`.
        reading: How the dataset is read.
        scene: The dataset's.
    """

    emulator: Emulator
    reading: Reading
    scene: Scene

    @property
    def identity(self) -> dict[str, Any]:
        """Plain data on which the predictions depend, beside those of the emulator."""
        reading = self.reading
        return {"materials": dict(reading.materials), "every": reading.every, "between": reading.between}

    @property
    def bundle(self) -> int:
        """Whole frames of the dataset that one call predicts at most, at least 1."""
        return max(1, self.frames(self.emulator.frames))

    def steps(self, frames: int) -> int:
        """Frames of the model that reach so many frames of the dataset."""
        return -(-frames * self.reading.between // self.reading.every)

    def frames(self, steps: int) -> int:
        """Whole frames of the dataset in so many of the model."""
        return steps * self.reading.every // self.reading.between

    def computed_frames(self, frames: int) -> int:
        """Whole frames of the dataset in the bundles that reach so many, at least these."""
        return max(frames, self.frames(-(-self.steps(frames) // self.emulator.frames) * self.emulator.frames))

    def predict(self, window: Window) -> Tensor:
        """Positions (B, T - 2, N, D) of the frames to predict of a window of the dataset, as it has them."""
        if window.present is not None:
            return predict_from_entries(self, window, self.bundle)
        if window.obstacle_frames is None:
            return self(window.initial, window.target.shape[1])
        obstacle = self._obstacle_path(window.obstacle_frames[:, 1:])
        return self(window.initial, window.target.shape[1], Prescribed.obstacles(obstacle))

    def __call__(self, particles: Particles, frames: int, prescribed: Prescribed | None = None) -> Tensor:
        """Positions (B, frames, N, D) of the dataset's next frames from a state of the dataset, in domain length."""
        state = self.state(particles)
        path = rollout(self.emulator, state, self.steps(frames), RolloutOptions(prescribed))
        if self.reading.every == 1:
            return path[:, self.reading.between - 1 :: self.reading.between]
        return interpolate(torch.cat([state.position.unsqueeze(1), path], 1), self.reading.every)[:, 1 : frames + 1]

    def state(self, particles: Particles) -> Particles:
        """A state of the dataset in the model's materials, with velocity and gravity per frame of the model."""
        ratio, gravity = self.reading.every / self.reading.between, self._gravity(particles)
        unknown = torch.full_like(particles.velocity, torch.nan)
        velocity = model_velocity(particles.velocity, unknown, gravity.unsqueeze(1), ratio)
        names, theirs = self.reading.materials, self.reading.scene.materials
        index = torch.tensor([theirs.index(names.get(name, name)) for name in self.scene.materials])
        last = particles.obstacle_velocity
        return dataclasses.replace(
            particles,
            velocity=velocity,
            gravity=gravity * ratio**2,
            material=index.to(gravity.device)[particles.material],
            obstacle_velocity=None if last is None else last * ratio,
        )

    def _gravity(self, particles: Particles) -> Tensor:
        """(B, D) gravity of a state in length per frame of the dataset²; the reading's where it states none."""
        measured = self.reading.scene.gravity
        if self.scene.gravity_known or measured is None:
            return particles.gravity
        return (particles.gravity.new_tensor(measured) * self.scene.dt**2).expand_as(particles.gravity)

    def _obstacle_path(self, frames: Tensor) -> Tensor:
        """Positions (B, F', M, D) of obstacles at the model's frames, of (B, F, M, D) at the dataset's."""
        return interpolate(frames[:, :: self.reading.every], self.reading.between)
