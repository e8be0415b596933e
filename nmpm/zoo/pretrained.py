"""Trained emulators with what is known of their training, and their rollouts."""

from __future__ import annotations

import copy
import dataclasses
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nmpm._support.machine import find_device
from nmpm.backends import AUTO
from nmpm.data.format import Trajectory
from nmpm.emulator import (
    NETWORK_PRECISIONS,
    Emulator,
    Prescribed,
    Rollout,
    RolloutOptions,
    differentiable_rollout,
    predict_rollout,
)
from nmpm.emulator.members import nudge_of
from nmpm.emulator.monitor import warn_of_start_outside
from nmpm.emulator.runtimes import Runtime
from nmpm.emulator.similarity import Match
from nmpm.emulator.trust import Trust, TrustTracker
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.scene import Scene
from nmpm.zoo.card import preset_of, stated_nudge
from nmpm.zoo.optimization import optimize
from nmpm.zoo.states import THROWN, TOO_FAST, Bodies, StateBuilder, state_of, thrown_state

if TYPE_CHECKING:
    from nmpm.data.datamodule import TrajectoryDataModule
    from nmpm.data.dataset import Dataset


TRUSTED = "trusted"
"""Says `until` that a rollout ends with the last trusted frame."""


@dataclass(frozen=True)
class Pretrained:
    """A trained model, ready to roll out or to fine-tune.

    Args:
        emulator: In evaluation mode.
        card: The content of `card.yaml`, or what is known of a checkpoint.
        match: How the emulator takes foreign data, once `fit_to` has made it do so.
    """

    emulator: Emulator
    card: Mapping[str, Any]
    match: Match | None = None

    def __repr__(self) -> str:
        """One line: name, data, network and device; the card is long."""
        weights = sum(values.numel() for values in self.emulator.parameters())
        network = f"{type(self.emulator.recipe.processor).__name__} of {weights:,} parameters on {self.emulator.device}"
        return f"<{type(self).__name__} {self.name}: {self.card.get('dataset', 'unknown data')}, {network}>"

    @property
    def scene(self) -> Scene:
        """The facts of the scenes that the model was trained for."""
        return self.emulator.scene

    @property
    def name(self) -> str:
        """The model's name in the zoo, or its checkpoint's path."""
        return str(self.card.get("name", "unnamed"))

    @property
    def horizon(self) -> int:
        """Frames that the training unrolled; 4 bundles where the card does not say."""
        training = self.card.get("training")
        stated = training.get("horizon") if isinstance(training, Mapping) else None
        return stated if isinstance(stated, int) and stated > 0 else 4 * self.emulator.frames

    @property
    def preset(self) -> str | None:
        """Name of the simulator preset that made the training data; None for recorded or unknown data."""
        return preset_of(self.card)

    @property
    def nudge(self) -> float:
        """Standard deviation of the displacements of members' starts, in cells: the card's, else the emulator's."""
        stated = stated_nudge(self.card)
        return nudge_of(self.emulator, None) if stated is None else stated

    @property
    def trust(self) -> Trust:
        """When members disagree so much that a rollout is one of many: as calibrated, see the card, or the default."""
        return Trust.from_card(self.card.get("trust"))

    @property
    def _too_fast(self) -> float:
        """The multiple of the calibrated speeds that is an error: none in data that were compared by a match."""
        return math.inf if self.match else TOO_FAST

    def state(
        self,
        position: ArrayLike | Tensor,
        velocity: ArrayLike | Tensor | None = None,
        material: str | Sequence[str] | ArrayLike | Tensor | None = None,
        obstacle: ArrayLike | Tensor | None = None,
        gravity: ArrayLike | Tensor | None = None,
        dtype: torch.dtype | None = None,
        fields: Mapping[str, ArrayLike | Tensor] | None = None,
        bodies: Bodies | None = None,
        volume: ArrayLike | Tensor | None = None,
    ) -> Particles:
        """A state to start a rollout from, per frame on the model's device: N particles in each of B scenes, D axes.

        Args:
            position: (N, D) or (B, N, D), in domain length.
            velocity: (D,), (N, D) or (B, N, D), in domain length per second; at rest when left out.
            material: A name of `scene.materials` for all particles; or (N,) or (B, N) names, or indices into
                `scene.materials`. May be left out where the scene has one material.
            obstacle: (M, D) or (B, M, D) positions of particles that fill the obstacles.
            gravity: (D,) or (B, D), in domain length per second squared. Needed where gravity varies; elsewhere it may
                be left out, and otherwise must be the scene's.
            dtype: Of positions, velocities and gravity. When left out, float32; or float64 where the domain is so far
                from the origin that float32 numbers are more than 2 × 10⁻⁴ cells apart (but on MPS, which lacks it).
            fields: Of `scene.fields`, by name: a number for all particles, (N,) or (B, N); (B,) of those that each
                scene has one of. One that is left out has its mean over the training data.
            bodies: Obstacles of `nmpm.obstacles`, of D dimensions: a list for all scenes, or a list for each of B. To
                their parameters, such as angles and sizes, gradients flow.
            volume: (N,) or (B, N) volumes of the particles, as multiples of `scene.particle_volume`; 1 when left out.

        Raises:
            DataError: if shapes do not fit together, values are not finite, a particle is outside of the domain or far
                faster than the model was calibrated for, a material is unknown, gravity is not the model's, or a volume
                not positive.
            ConfigError: if a body is impossible, or outside of the domain.

        Warns:
            UserWarning: if the velocities look as if they were per frame, particles start inside an obstacle, or the
                positions' type is too coarse so far from the origin; naming fields that the model does not have.
        """
        builder = StateBuilder(self.emulator, position, dtype, self._too_fast)
        return builder.build(velocity, material, obstacle, gravity, fields, bodies, volume).to(self.emulator.device)

    def start(self, trajectory: Trajectory, frame: int = 1, materials: Mapping[str, str] | None = None) -> Particles:
        """The state of a recorded trajectory at a frame, to start a rollout from.

            data = nmpm.load_trajectories("grains")
            model.rollout(model.start(data.test[0]), frames=100)

        Velocities are those from the frame before, or in a model of other frames the best estimate of that between
        two of these; obstacles are taken apart, and particles that are absent in between are left out. Sizes of
        particles are relative to the mean of those that are there.

        Args:
            trajectory: From `nmpm.load_trajectories`, which knows the names of its types; one made of arrays suffices
                for a model of one material.
            frame: 1 or later.
            materials: The model's material by name of the trajectory's, where they differ; those of `match` are known.

        Raises:
            DataError: if the trajectory's materials are not the model's, no particle is there, or as for `state`.
            ConfigError: if there is no such frame.
        """
        return state_of(self.emulator, trajectory, frame, materials, self._too_fast)

    def example(
        self,
        seed: int = 0,
        count: int | None = None,
        blocks: int | None = None,
        gravity: ArrayLike | Tensor | None = None,
    ) -> Particles:
        """A state to start from: a scene of the preset that the model was trained on, with its obstacles.

        With `count` or `blocks`, and where no shipped preset has the model's scenes, blocks of particles thrown into
        the scene's box.

        Args:
            seed: Of the scene, 0 or more.
            count: Approximate number of thrown particles; 1000 when only `blocks` is given.
            blocks: Number of thrown blocks; one of each material when only `count` is given.
            gravity: (D,), as for `state`. Where it varies and is left out, it is drawn with the scene; of thrown blocks
                downwards along the second axis, as strong as in the root mean square of the training.

        Raises:
            ConfigError: if a number is too small, or the blocks do not fit into the box.
            DataError: if gravity is not the model's.
        """
        from nmpm.zoo.scenes import drawn_state, training_preset  # (the simulators compile kernels by numba)

        preset = training_preset(self.scene, self.preset) if count is None and blocks is None else None
        if preset is None:
            return thrown_state(self.emulator, seed, THROWN if count is None else count, blocks, gravity)
        return drawn_state(self.emulator, preset, seed, gravity)

    def rollout(
        self, state: Particles, frames: int, prescribed: Prescribed | None = None,
        members: int | None = None, seed: int = 0, nudge: float | None = None,
        until: str | None = None,
    ) -> Tensor:  # fmt: skip
        """Predict positions (B, frames, N, D) in domain length from a state, whose own frame is not among them.

        Args:
            state: From `state`, or a window's `initial`; several of any size at once by `Particles.stack`.
            frames: How many.
            prescribed: Obstacles that move, `Prescribed.obstacles(positions)`, or particles that enter and leave too,
                `Prescribed.of(window)`. Positions of particles that are not there are NaN, as are those of particles
                that have left through an open axis.
            members: So many rollouts of each scene, (M, B, frames, N, D), see `nmpm.emulator.members`: by the noise
                that the model was trained with, or else from nudged starts. None for one, (B, frames, N, D).
            seed: Of members: each depends on it, its number and its scene, not on how many there are.
            nudge: Standard deviation of the displacements of members' starts in cells; `model.nudge` if left out.
            until: "trusted" to end with the last frame that is trusted, see `nmpm.emulator.trust`. Of several scenes
                the last of all; those that are lost before are NaN from then on. A single rollout is compared with two
                that start nearby, which costs three times the time.

        Raises:
            ConfigError: if a number is too small, a nudge is given without members, or `until` is another word.

        Warns:
            UserWarning: if particles start outside of the bounds, into which the first frame moves them.
        """
        return self.predict(state, frames, prescribed, members, seed, nudge, until).position

    def predict(
        self, state: Particles, frames: int, prescribed: Prescribed | None = None,
        members: int | None = None, seed: int = 0, nudge: float | None = None,
        until: str | None = None,
    ) -> Rollout:  # fmt: skip
        """As `rollout`, with the particles' evolving fields beside their positions, and the last trusted frames."""
        if until not in (None, TRUSTED):
            raise ConfigError(f"until = {until!r}: a rollout ends after its frames (None) or until={TRUSTED!r}.")
        if nudge is not None and members is None:
            raise ConfigError(f"nudge = {nudge!r} displaces the starts of members: give members=8, too.")
        there, given = state.to(self.emulator.device), prescribed and prescribed.to(self.emulator.device)
        warn_of_start_outside(self.emulator, there)
        size = self.nudge if nudge is None else nudge
        tracker = None if until is None else TrustTracker(self.emulator.scene, there, self.trust)
        options = RolloutOptions(
            given, members=members, seed=seed, nudge=size, tracker=tracker, until_trusted=until is not None
        )
        return predict_rollout(self.emulator, there, frames, options)

    def differentiable_rollout(self, state: Particles, frames: int) -> Tensor:
        """As `rollout`, with gradients to the state, see `nmpm.emulator.differentiable_rollout`.

        Memory grows by one state per bundle; backward passes compute each bundle again.
        """
        there = state.to(self.emulator.device)
        warn_of_start_outside(self.emulator, there)
        return differentiable_rollout(self.emulator, there, frames)

    def with_network(self, precision: str) -> Pretrained:
        """The same model with the network's weights in "float32" or, faster on most processors, in "bfloat16"."""
        if precision not in NETWORK_PRECISIONS:
            raise ConfigError(f"Networks run in {' or '.join(NETWORK_PRECISIONS)}, not in {precision!r}.")
        return dataclasses.replace(self, emulator=self.emulator.with_network(NETWORK_PRECISIONS[precision]))

    def fit_to(
        self,
        data: Scene | str | Path | Dataset | TrajectoryDataModule,
        materials: Mapping[str, str] | None = None,
        stride: Fraction | float | str | None = None,
        strict: bool = False,
    ) -> Pretrained:
        """The same weights for foreign data, in their units: on cells, and at frames, in which they are like its own.

            model = Zoo.load("sandramps").fit_to("grains", materials={"big": "sand", "small": "sand"})
            print(*model.match.lines)

        Args:
            data: A scene; or a file or folder, a dataset of `nmpm.load_trajectories` or a datamodule, of which speeds
                are measured, too.
            materials: This model's material by the data's name; those left out are told by their names.
            stride: Frames of the data for one of this model, such as 2 or "1/4"; the best one if left out.
            strict: Whether to raise a ConfigError for what could not be matched, see
                `nmpm.emulator.similarity.find_match`.

        Warns:
            UserWarning: for each thing that could not be matched, with its factor.
        """
        from nmpm.zoo.matching import match_data  # imports all readers of data

        match = match_data(self.emulator, self.name, data, materials, stride, strict)
        for warning in match.warnings:
            warnings.warn(warning, stacklevel=2)
        return self.matched(match)

    def matched(self, match: Match) -> Pretrained:
        """The same weights for the data of a match, see `fit_to`."""
        return dataclasses.replace(self, emulator=self.emulator.matched(match), match=match)

    def over(self, scene: Scene) -> Pretrained:
        """As `fit_to`, for a scene such as `dataclasses.replace(model.scene, bounds=…, domain=…)`."""
        return self.fit_to(scene)

    def optimized(
        self, runtime: str | Runtime = AUTO, precision: str | None = None, state: Particles | None = None
    ) -> Pretrained:
        """The same model for inference alone, its network computed by a faster runtime than torch.

        One bundle of an example is compared with torch's. Programs are compiled in the first call for each batch and
        grid, in a second or two, for as many threads as torch then has. This model is left as it is.

        Args:
            runtime: One of `nmpm.backends.RUNTIMES`, by name or made with options: "openvino" (CPU, needs extra
                `openvino`), "windows" (large scenes that are mostly empty), or "eager", torch itself; "auto" for the
                faster of openvino and eager here, as measured in short rollouts; or the name of one of `ENGINES` there,
                which computes all else of a call. On a CUDA GPU calls by eager are recorded as CUDA graphs without
                being asked.
            precision: As for `with_network`; the network's own if left out.
            state: Of the scenes to roll out: "auto" measures in them, and tries windows, too, which pay where a large
                grid is mostly empty.

        Raises:
            ConfigError: if the runtime is not installed, cannot run the model here, or computes something else.
        """
        model = self if precision is None else self.with_network(precision)
        return dataclasses.replace(model, emulator=optimize(model.emulator, runtime, state))

    def explain(self) -> None:
        """Print what computes rollouts and trainings on the model's device, and why nothing faster does."""
        sys.stdout.write(f"{self.emulator.explain()}\n")

    def to(self, device: torch.device | str) -> Pretrained:
        """The model on another device: "cpu", "cuda", "cuda:1", "mps", or "auto" for a GPU where there is one.

        This model is left where it is; the returned one has a copy of its tensors if the device differs.

        Raises:
            ConfigError: if this machine does not have the device.
        """
        target = find_device(device)
        if target.type == self.emulator.device.type and target.index in (None, self.emulator.device.index):
            return self
        return dataclasses.replace(self, emulator=copy.deepcopy(self.emulator).to(target))
