"""The rollouts of a trained model: one future or several, as far as they can be trusted, or on by a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from nmpm.emulator import Emulator, Prescribed, Rollout, differentiable_rollout, predict_rollout
from nmpm.emulator.input_checks import warn_of_start_outside
from nmpm.emulator.members import nudge_of, predict_members
from nmpm.emulator.trust import Trust, predict_trusted
from nmpm.errors import ConfigError
from nmpm.particles import Particles
from nmpm.zoo.card import stated_nudge

if TYPE_CHECKING:
    from nmpm.sim import Preset

TRUSTED = "trusted"
"""Says `until` that a rollout ends with the last trusted frame."""


@dataclass(frozen=True)
class Predictor:
    """An emulator and what its card states about its rollouts; the base of `Pretrained`."""

    emulator: Emulator
    card: Mapping[str, Any]

    @property
    def nudge(self) -> float:
        """Standard deviation of the displacements of members' starts, in cells: the card's, else the emulator's."""
        stated = stated_nudge(self.card)
        return nudge_of(self.emulator, None) if stated is None else stated

    @property
    def trust(self) -> Trust:
        """When members disagree so much that a rollout is one of many: as calibrated, see the card, or the default."""
        return Trust.from_card(self.card.get("trust"))

    def rollout(
        self, state: Particles, frames: int, prescribed: Prescribed | None = None,
        members: int | None = None, seed: int = 0, nudge: float | None = None,
        until: str | None = None, fallback: Preset | str | Path | None = None,
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
            fallback: A simulator preset, its name or file, that makes all further frames of each scene from its last
                trusted one, without strain and pressure at first. Its scenes must be the model's.

        Raises:
            ConfigError: if a number is too small, a nudge is given without members, `until` is another word, or the
                fallback simulates other scenes, or is given with members or what is prescribed.
            UnstableError: if the simulator becomes unstable.

        Warns:
            UserWarning: if particles start outside of the bounds, into which the first frame moves them.
        """
        return self.predict(state, frames, prescribed, members, seed, nudge, until, fallback).position

    def predict(
        self, state: Particles, frames: int, prescribed: Prescribed | None = None,
        members: int | None = None, seed: int = 0, nudge: float | None = None,
        until: str | None = None, fallback: Preset | str | Path | None = None,
    ) -> Rollout:  # fmt: skip
        """As `rollout`, with the particles' evolving fields beside their positions, and the last trusted frames."""
        if until not in (None, TRUSTED):
            raise ConfigError(f"until = {until!r}: a rollout ends after its frames (None) or until={TRUSTED!r}.")
        if nudge is not None and members is None:
            raise ConfigError(f"nudge = {nudge!r} displaces the starts of members: give members=8, too.")
        if fallback is not None and (members is not None or prescribed is not None):
            raise ConfigError(
                "fallback: a simulator goes on from one rollout of what moves freely: leave members and what is"
                " prescribed out."
            )
        there, given = state.to(self.emulator.device), prescribed and prescribed.to(self.emulator.device)
        warn_of_start_outside(self.emulator, there)
        size = self.nudge if nudge is None else nudge
        if fallback is not None:
            from nmpm.zoo.fallback import predict_and_simulate  # imported late, as it imports simulators

            return predict_and_simulate(self.emulator, self.trust, there, frames, fallback)
        if until is not None:
            return predict_trusted(self.emulator, self.trust, there, frames, given, members, seed, size)
        if members is not None:
            return predict_members(self.emulator, there, frames, members, seed, size, given)
        return predict_rollout(self.emulator, there, frames, prescribed=given)

    def differentiable_rollout(self, state: Particles, frames: int) -> Tensor:
        """As `rollout`, with gradients to the state, see `nmpm.emulator.differentiable_rollout`.

        Memory grows by one state per bundle; backward passes compute each bundle again.
        """
        there = state.to(self.emulator.device)
        warn_of_start_outside(self.emulator, there)
        return differentiable_rollout(self.emulator, there, frames)
