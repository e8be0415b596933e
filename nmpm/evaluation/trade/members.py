"""Ensembles of an emulator's rollouts as a choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from nmpm.emulator import Prescribed
from nmpm.emulator.members import predict_members
from nmpm.evaluation.trade.choices import ModelChoice, Rollout
from nmpm.evaluation.trade.scenes import Scenes


@dataclass(frozen=True, eq=False, kw_only=True)
class MembersChoice(ModelChoice):
    """Several rollouts of each scene, see `nmpm.emulator.members`; a scene's time is that of all of them.

    Args:
        members: M. Errors of positions are those of the first, `crps` is that of all.
        nudge: Cells by which starts are displaced, see `nmpm.emulator.members.member_starts`.
    """

    members: int
    nudge: float

    @property
    def identity(self) -> Mapping[str, Any]:
        return {**super().identity, "members": self.members, "nudge": self.nudge}

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        (index,) = indices
        window = scenes.window(indices)
        state, prescribed = window.initial.to(self.device), Prescribed.of(window)
        given = prescribed and prescribed.to(self.device)

        def predict(frames: int) -> Tensor:
            members = predict_members(self.emulator, state, frames, self.members, index, self.nudge, given)
            return members.position[:, 0]

        return predict
