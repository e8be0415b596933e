"""An emulator's members in test scenes, scored beside its one rollout of each."""

from __future__ import annotations

import statistics
import sys
from typing import Any

import torch
from torch import Tensor

from nmpm._support.collectives import all_gather
from nmpm.emulator import Emulator, Prescribed, RolloutOptions, stream_rollout
from nmpm.emulator.members import nudge_of
from nmpm.emulator.prescribed import with_predicted
from nmpm.evaluation.bootstrap import interval
from nmpm.metrics.ensembles import EnsembleScores
from nmpm.particles import Window

FRAMES = (100,)
"""Frames at which members are scored, beside the last one."""
_SCORES = ("energy_score", "spread_skill", "coverage50", "coverage90")


class EnsembleTest:
    """Adds up the scores of members and of the one rollout without noise, over scenes.

    Args:
        emulator: In evaluation mode.
        members: M of each scene.
        nudge: Cells by which starts are displaced, see `nmpm.emulator.members.member_starts`.
        every: Frames of the data, which `FRAMES` count, per frame of the emulator.
    """

    def __init__(self, emulator: Emulator, members: int, nudge: float | None = None, every: int = 1) -> None:
        self.emulator, self.members, self.nudge = emulator, members, nudge_of(emulator, nudge)
        self.scores = EnsembleScores(emulator.scene, FRAMES, every)
        self.single = EnsembleScores(emulator.scene, FRAMES, every)

    def update(self, window: Window, predicted: Tensor) -> None:
        """Roll a scene's members out and add them.

        Args:
            window: One recorded scene of T + 2 frames; with the scenes before it, it determines the members.
            predicted: (1, T, N, D) the one rollout.
        """
        start, frames, seed = window.to(self.emulator.device), window.target.shape[1], len(self.scores.rows)
        prescribed, scored = Prescribed.of(start), with_predicted(window, self.emulator.frames).to("cpu")
        options = RolloutOptions(prescribed, members=self.members, seed=seed, nudge=self.nudge)
        parts = stream_rollout(self.emulator, start.initial, frames, options)
        self.scores.update(scored, (part.position for part in parts))
        self.single.update(scored, [predicted])

    def gather(self) -> None:
        """Add the scenes of all processes."""
        for scores in (self.scores, self.single):
            scores.rows = [row for rows in all_gather(scores.rows) for row in rows]
            ranks = all_gather(scores.ranks)
            names = dict.fromkeys(name for one in ranks for name in one)
            scores.ranks = {name: torch.stack([one[name] for one in ranks if name in one]).sum(0) for name in names}

    def overall_score(self) -> float:
        """Geometric mean of the CRPS of the density at the frames that are scored."""
        means = self.scores.compute()
        crps = [max(value, sys.float_info.min) for name, value in means.items() if name.startswith("crps_density")]
        return statistics.geometric_mean(crps)

    def to_dict(self) -> dict[str, Any]:
        """The scores as plain data, as reports and cards hold them under `ensemble`.

        Returns:
            `members`; `nudge` in cells, of emulators without noise; and under `scores`, by quantity and frame
            ("density@100", "density" in the last one), `crps` with its 95% `interval` over scenes, that of the one
            rollout (`single`), `spread_skill`, `coverage50` and `coverage90`, of densities also the `energy_score`.
        """
        means, single = self.scores.compute(), self.single.compute()
        scores = {}
        for name in [name.removeprefix("crps_") for name in means if name.startswith("crps_")]:
            crps = [row[f"crps_{name}"] for row in self.scores.rows if f"crps_{name}" in row]
            scores[name] = {
                "crps": means[f"crps_{name}"],
                "interval": list(interval(crps)),
                "single": single[f"crps_{name}"],
                **{score: means[f"{score}_{name}"] for score in _SCORES if f"{score}_{name}" in means},
            }
        nudge = {} if self.emulator.processor.noise else {"nudge": self.nudge}
        return {"members": self.members, **nudge, "scores": scores}
