"""Choices: whatever predicts scenes in a comparison of time and error, be it an emulator, the simulator or another."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from typing import Any, Protocol

import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from nmpm._support.messages import one_line
from nmpm.emulator import Emulator, Prescribed, RolloutOptions, rollout
from nmpm.emulator.digests import weights_digest
from nmpm.emulator.prescribed import predict_from_entries, with_predicted
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.matched import MatchedPredictor
from nmpm.evaluation.prediction_errors import energy_gain, recorded_energy_gain
from nmpm.evaluation.trade.scenes import Scenes
from nmpm.particles import Particles, Window
from nmpm.scene import Scene
from nmpm.sim import InitialState, Preset
from nmpm.sim.preset import nudge

Run = Callable[[int], Tensor]
"""From a number of frames to (B, frames, N, D) predicted positions, in domain length."""

Settings = Mapping[str, str | int | float]

CPU = torch.device("cpu")


class Kind(StrEnum):
    """The kind of a choice; floors, the simulator beside itself, are drawn and never recommended."""

    MODEL = "model"
    OTHER = "other"
    SIMULATOR = "simulator"
    TRIVIAL = "trivial"
    FLOOR = "floor"


@dataclass(frozen=True, eq=False, kw_only=True)
class Choice(ABC):
    """One way of predicting scenes, at one setting.

    Args:
        kind: Kind of predictor.
        name: Unique among the choices that are compared.
        settings: By column of the table.
        batch: Scenes predicted at once when it is timed; predictions do not depend on it.
        device: Where it computes.
    """

    kind: Kind
    name: str
    settings: Settings = field(default_factory=dict)
    batch: int = 1
    device: torch.device = CPU

    @property
    def bundle(self) -> int:
        """Frames predicted at once: particles that enter count from the start of the next bundle on."""
        return 1

    @property
    @abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """Plain data on which its predictions depend, beside the scenes: the key of stored measurements."""

    @abstractmethod
    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Run:
        """Load what the rollouts of some scenes start from, which is not timed.

        Returns:
            Predicts the frames after each scene's first two. It raises an NmpmError where it fails.
        """

    def computed_frames(self, frames: int) -> int:
        """Frames that a rollout of so many frames computes: the time of a frame is its time over these."""
        return frames

    def predict(self, scenes: Scenes, index: int) -> tuple[Tensor, float]:
        """Predict all frames of one scene, which is not timed.

        Returns:
            (1, T, N, D) positions of the recorded particles, of any value where one does not count, and the
            prediction's `energy_gain`.

        Raises:
            NmpmError: if it fails; a DataError if positions are not finite.
        """
        position = self.prepare(scenes, [index])(scenes.frames(index)).cpu().float()
        window = with_predicted(scenes.window([index]), self.bundle)
        counts = None if window.present is None else window.present[:, 2:].unsqueeze(-1)
        require_finite(position if counts is None else position.where(counts, 0.0))
        return position, recorded_energy_gain(scenes.scene, window, position)


def first_forms(choices: Sequence[Choice]) -> list[Choice]:
    """The choices without the further forms of each model: its other precisions, batches, runtimes, its members."""
    first: dict[object, Choice] = {}
    return [c for c in choices if c.kind is not Kind.MODEL or first.setdefault(c.settings["model"], c) is c]


def digest(plain: Any) -> str:
    """A key of plain data: SHA-256 of its JSON, in short."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:20]


def require_finite(position: Tensor) -> Tensor:
    """The positions (B, T, N, D); raises DataError if any is not finite, naming the first such frame."""
    broken = (~position.isfinite()).flatten(2).any(-1).any(0)
    if bool(broken.any()):
        raise DataError(f"Positions are not finite from predicted frame {int(broken.nonzero()[0, 0]) + 1} on.")
    return position


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelChoice(Choice):
    """A trained emulator, in evaluation mode, on the choice's device; `matched` predicts other kinds of scenes."""

    emulator: Emulator
    matched: MatchedPredictor | None = None
    kind: Kind = Kind.MODEL

    @property
    def bundle(self) -> int:
        return self.emulator.frames if self.matched is None else self.matched.bundle

    @property
    def identity(self) -> Mapping[str, Any]:
        identity = {
            "recipe": self.emulator.recipe.to_dict(),
            "weights": weights_digest(self.emulator.state_dict()),
            "device": self.device.type,
            "runtime": self.emulator.runtime.name,
        }
        return identity | ({} if self.matched is None else {"reading": self.matched.identity})

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Run:
        window = scenes.window(indices)
        if (matched := self.matched) is not None:
            there = window.to(self.device)
            return lambda frames: matched.predict(there.first(frames + 2))
        state, prescribed = self._start(window)
        return lambda frames: rollout(self.emulator, state, frames, RolloutOptions(prescribed))

    def _start(self, window: Window) -> tuple[Particles, Prescribed | None]:
        """What a rollout of a window starts from, and what is prescribed to it, on the choice's device."""
        prescribed = Prescribed.of(window)
        return window.initial.to(self.device), prescribed and prescribed.to(self.device)

    def computed_frames(self, frames: int) -> int:
        if self.matched is not None:
            return self.matched.computed_frames(frames)
        return -(-frames // self.emulator.frames) * self.emulator.frames  # whole bundles


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatorChoice(Choice):
    """A simulator, from the initial state of each trajectory, of which frames 0 and 1 are left out.

    Where its particles are others than the recorded ones (larger particles of SPH), a recorded particle moves like
    the simulated one that was nearest to it initially. Errors are those of the recorded particles, the energy gain is
    that of the simulated ones.

    Args:
        preset: Resolution and substeps; the initial states are drawn from it.
        nudge: Standard deviation of Gaussian noise on the initial positions, as a share of the domain's longest side.
    """

    preset: Preset
    nudge: float = 0.0
    kind: Kind = Kind.SIMULATOR

    @property
    def identity(self) -> Mapping[str, Any]:
        # The number of frames of the preset's own trajectories does not matter.
        return {"preset": self.preset.with_frames(1).to_dict(), "revision": self.preset.revision, "nudge": self.nudge}

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Run:
        (index,) = indices
        start = self._draw(scenes, index)
        follow = follow_nearest(scenes.recordings[index].frames[0], start.position)
        return lambda frames: follow(self._simulate(start, frames))[2:].unsqueeze(0)

    def computed_frames(self, frames: int) -> int:
        return frames + 1  # from the initial state on, of which a rollout leaves out two frames

    def predict(self, scenes: Scenes, index: int) -> tuple[Tensor, float]:
        window = scenes.window([index])
        if self.preset is scenes.preset and not self.nudge:  # it made the scenes
            return window.target, recorded_energy_gain(scenes.scene, window, window.target)
        start, recording = self._draw(scenes, index), scenes.recordings[index]
        simulated = self._simulate(start, scenes.frames(index))
        first = recording.frames[0]
        position = require_finite(follow_nearest(first, start.position)(simulated)[2:].unsqueeze(0))
        if first.shape == simulated[0].shape:
            return position, recorded_energy_gain(scenes.scene, window, position)
        counts = torch.tensor(start.counts or (len(start.position),))
        material = torch.arange(len(counts)).repeat_interleave(counts)
        path = require_finite(simulated.unsqueeze(0))[0]
        return position, energy_gain(self.preset.scene, path, material, recording.gravity)

    def _draw(self, scenes: Scenes, index: int) -> InitialState:
        start = self.preset.draw(scenes.seeds[index])
        return nudge(self.preset, start, self.nudge, scenes.seeds[index]) if self.nudge else start

    def _simulate(self, start: InitialState, frames: int) -> Tensor:
        """(frames + 2, M, D): the initial state, the frame that every rollout starts from, and the predicted ones."""
        return torch.from_numpy(self.preset.simulate_from(start, frames + 1).position[:, : len(start.position)])


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


class Predictor(Protocol):
    """A predictor of another package; it computes on the CPU.

    Attributes:
        name: Unique among the choices. Measurements are stored by it: it must change when the predictions do.
    """

    name: str

    def __call__(self, particles: Particles, frames: int) -> Tensor:
        """Positions (B, frames, N, D) of the next frames, in domain length.

        An NmpmError, or positions that are not finite, make it count as unstable.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictorChoice(Choice):
    """A trivial predictor, or one of another package: from particles and a number of frames to positions.

    Args:
        predictor: Predicts on its own from the frame in which particles enter.
        enter_every: Frames between these, as of the models that it stands beside.
    """

    predictor: Callable[[Particles, int], Tensor]
    enter_every: int = 1

    @property
    def bundle(self) -> int:
        return self.enter_every

    @property
    def identity(self) -> Mapping[str, Any]:
        return {self.kind.value: self.name} | ({"enter_every": self.enter_every} if self.enter_every > 1 else {})

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Run:
        window = scenes.window(indices)
        batch, _, count, dim = window.frames.shape

        def predict(frames: int) -> Tensor:
            if window.present is None:
                position = self.predictor(window.initial, frames)
            else:
                position = predict_from_entries(self.predictor, window.first(frames + 2), self.bundle)
            shape = (batch, frames, count, dim)
            if tuple(position.shape) != shape:
                raise DataError(f"{self.name} returns {tuple(position.shape)} positions, not {shape}.")
            return position

        return predict


def find_factory(path: str) -> Callable[[Scene], Predictor]:
    """Import what makes a predictor for a scene; the code in its module runs.

    Args:
        path: `module:factory`, called with the scene, or `module:factory:argument`, called with that text too.

    Raises:
        ConfigError: if there is no such factory; when called, if it makes no `Predictor`.
    """
    module, _, rest = path.partition(":")
    name, *argument = rest.split(":", 1)
    try:
        factory = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"--predictors {path}: {one_line(error)}. Give module:factory[:argument].") from error

    def make(scene: Scene) -> Predictor:
        predictor: Predictor = factory(scene, *argument)
        if not callable(predictor) or not isinstance(getattr(predictor, "name", None), str):
            raise ConfigError(f"--predictors {path}: it returned {predictor!r}, no callable with a name.")
        return predictor

    return make


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

    def prepare(self, scenes: Scenes, indices: Sequence[int]) -> Run:
        (index,) = indices
        start, prescribed = self._start(scenes.window(indices))
        options = RolloutOptions(prescribed, members=self.members, seed=index, nudge=self.nudge)

        def predict(frames: int) -> Tensor:
            return rollout(self.emulator, start, frames, options)[:, 0]

        return predict
