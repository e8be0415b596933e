"""The simulator of the scenes as a choice: with fewer substeps, on a coarser grid, of larger particles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from nmpm.evaluation.trade.choice import Choice, Kind, Prediction, Rollout, require_finite
from nmpm.evaluation.trade.errors import energy_gain
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.sim import Preset
from nmpm.sim.predictability import nudge
from nmpm.sim.state import InitialState


@dataclass(frozen=True, eq=False)
class SimulatorChoice(Choice):
    """A simulator, from the initial state of each trajectory, of which frames 0 and 1 are left out.

    Where its particles are others than the recorded ones (larger particles of SPH), a recorded particle moves like
    the simulated one that was nearest to it initially. Errors are those of the recorded particles, the energy gain is
    that of the simulated ones.

    Args:
        name: Unique among the choices.
        preset: Resolution and substeps; the initial states are drawn from it.
        settings: What was chosen.
        nudge: Standard deviation of Gaussian noise on the initial positions, as a share of the domain's longest side.
        kind: A simulator, or a floor.
    """

    name: str
    preset: Preset
    settings: Mapping[str, str | int | float]
    nudge: float = 0.0
    kind: Kind = Kind.SIMULATOR
    batch: int = field(default=1, init=False)
    threads: int = field(default=1, init=False)

    @property
    def identity(self) -> Mapping[str, Any]:
        # The number of frames of the preset's own trajectories does not matter.
        return {"preset": self.preset.with_frames(1).to_dict(), "revision": self.preset.revision, "nudge": self.nudge}

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Rollout:
        (index,) = indices
        start = self._draw(scenes, index)
        follow = follow_nearest(scenes.recordings[index].frames[0], start.position)
        return lambda frames: follow(self._simulate(start, frames))[2:].unsqueeze(0)

    def computed_frames(self, frames: int) -> int:
        return frames + 1  # from the initial state on, of which a rollout leaves out two frames

    def predict(self, scenes: Scenes, index: int, frames: int) -> Prediction:
        start, recording = self._draw(scenes, index), scenes.recordings[index]
        simulated = self._simulate(start, frames)
        first = recording.frames[0]
        position = require_finite(follow_nearest(first, start.position)(simulated)[2:].unsqueeze(0))
        if first.shape == simulated[0].shape:
            return Prediction(position)
        return Prediction(position, self._gain(start, simulated, recording.gravity))

    def _draw(self, scenes: Scenes, index: int) -> InitialState:
        start = self.preset.draw(scenes.seeds[index])
        return nudge(self.preset, start, self.nudge, scenes.seeds[index]) if self.nudge else start

    def _simulate(self, start: InitialState, frames: int) -> Tensor:
        """(frames + 2, M, D): the initial state, the frame that every rollout starts from, and the predicted ones."""
        return torch.from_numpy(self.preset.simulate_from(start, frames + 1).position[:, : len(start.position)])

    def _gain(self, start: InitialState, simulated: Tensor, gravity: Tensor) -> float:
        """Energy gain of the simulated particles (T, M, D); `gravity` (D,) in length per frame squared."""
        counts = torch.tensor(start.counts or (len(start.position),))
        material = torch.arange(len(counts)).repeat_interleave(counts)
        return energy_gain(self.preset.scene, require_finite(simulated.unsqueeze(0))[0], material, gravity)


def follow_nearest(first: Tensor, start: NDArray[Any]) -> Callable[[Tensor], Tensor]:
    """From simulated paths (T, M, D) to paths (T, N, D) of the recorded particles.

    Args:
        first: (N, D) initial positions of the recorded particles.
        start: (M, D) those of the simulated ones: the same, or else a recorded particle moves like the nearest.
    """
    if first.shape == start.shape:
        return lambda simulated: simulated
    nearest = torch.from_numpy(cKDTree(start).query(first.numpy())[1])
    return lambda simulated: first + (simulated - simulated[0])[:, nearest]
