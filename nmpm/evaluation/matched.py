"""A dataset's frames, predicted by an emulator that reads it with other materials or at other frames."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from nmpm._support.messages import counted
from nmpm.data.loading.model_frames import model_velocity
from nmpm.emulator import Emulator, EmulatorRecipe, Prescribed, rollout
from nmpm.emulator.prescribed import predict_from_entries
from nmpm.emulator.similarity import Match
from nmpm.particles import Particles, Window
from nmpm.scene import Motion, Reading, Scene


class MatchFinder(Protocol):
    """`nmpm.emulator.similarity.find_match`, or that with some of its arguments given."""

    def __call__(
        self, emulator: Emulator, scene: Scene, motion: Motion | None = None, *, names: tuple[str, str] = ...
    ) -> Match: ...


def is_plain(reading: Reading) -> bool:
    """Whether a dataset is read as it is, with its own materials and frames."""
    return not reading.materials and reading.every == reading.between == 1


def describe_match(emulator: Emulator, match: Match) -> str:
    """How a model takes scenes of another kind, in a phrase: "4 frames for 1 of the data, gravity × 1.02"."""
    factor = gravity_factor(emulator, match)
    gravity = "" if factor is None else f", gravity × {factor:.3g}"
    return f"{counted(match.reading.between, 'frame')} for {match.reading.every} of the data{gravity}"


def gravity_factor(emulator: Emulator, match: Match) -> float | None:
    """Gravity of the data over the model's, in cells per frame²; None where one has none, or several."""
    ours, theirs = gravity_in_cells(emulator.recipe), gravity_in_cells(match.recipe)
    return theirs / ours if ours and theirs else None


def gravity_in_cells(recipe: EmulatorRecipe) -> float:
    """|g| Δt²/h of the scenes, in cells per frame²; 0 where they have none, or each its own."""
    gravity = recipe.scene.gravity or (0.0,) * recipe.scene.dim
    return math.hypot(*(g / h for g, h in zip(gravity, recipe.grid.spacing, strict=True))) * recipe.scene.dt**2


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
        path = rollout(self.emulator, state, self.steps(frames), prescribed=prescribed)
        if self.reading.every == 1:
            return path[:, self.reading.between - 1 :: self.reading.between]
        return between_frames(torch.cat([state.position.unsqueeze(1), path], 1), self.reading.every)[:, 1 : frames + 1]

    def state(self, particles: Particles) -> Particles:
        """A state of the dataset in the model's materials, with velocity and gravity per frame of the model."""
        ratio, gravity = self.reading.every / self.reading.between, self._gravity(particles)
        unknown = torch.full_like(particles.velocity, torch.nan)
        velocity = model_velocity(particles.velocity, unknown, gravity.unsqueeze(1), ratio)
        index = torch.tensor(material_indices(self.scene, self.reading)).to(gravity.device)
        last = particles.obstacle_velocity
        return dataclasses.replace(
            particles,
            velocity=velocity,
            gravity=gravity * ratio**2,
            material=index[particles.material],
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
        return between_frames(frames[:, :: self.reading.every], self.reading.between)


def material_indices(scene: Scene, reading: Reading) -> Sequence[int]:
    """The index of the model's material of each of a dataset's."""
    return [reading.scene.material_index(reading.materials.get(name, name)) for name in scene.materials]


def between_frames(frames: Tensor, parts: int) -> Tensor:
    """(B, (T - 1) parts + 1, N, D) frames, of (B, T, N, D) ones, with others linearly between them."""
    share = torch.arange(parts, device=frames.device, dtype=frames.dtype).view(1, 1, -1, 1, 1) / parts
    first, second = frames[:, :-1].unsqueeze(2), frames[:, 1:].unsqueeze(2)
    return torch.cat([torch.lerp(first, second, share).flatten(1, 2), frames[:, -1:]], 1)
