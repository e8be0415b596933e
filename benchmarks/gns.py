"""Train a particle-graph network (GNS, see `graph_network.py`) on an embedded dataset, as a baseline for `nmpm trade`.

    python benchmarks/gns.py goop --minutes 2 5 10 --out runs/gns
    PYTHONPATH=benchmarks nmpm trade goop --models goop --predictors gns:load:runs/gns/minutes-{2,5,10}.pt

It is trained one step ahead, with noise on the positions seen. Minutes are CPU time of one thread, of training alone.
The simulator is written at each of them, with its validation loss so far, so that `nmpm trade` shows error against
training time, and names what has not converged. After an interruption the same command goes on from the last of them,
or from the last validation between them.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from graph_network import HISTORY, GraphSimulator, Neighbours, extend_back
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm.data.catalog import ensure
from nmpm.data.format import Split, read_metadata
from nmpm.data.recordings import SplitRecordings
from nmpm.data.scene_inference import infer_scene
from nmpm.data.windows import Recording
from nmpm.emulator.digests import weights_digest
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Particles
from nmpm.scene import Reading, Scene
from nmpm.sim import preset_names

CHECKS = 24
"""Validation losses per training, beside those of the written simulators."""
STEADY = 0.02
"""A training has converged if its validation loss fell by less than this share over the last half of its time."""
SAMPLES, VALIDATED = 200, 16
"""Windows from which statistics are computed, and of which the validation loss is the mean."""
DECAY, WARM_UP = 0.01, 50
"""Last learning rate over the first, and steps over which it rises."""


@dataclass(frozen=True)
class Training:
    """How a graph simulator is trained: seconds of the schedule, noise of the last velocity in length per frame,
    windows of a step, Adam's first learning rate, and the seed of windows and noise.
    """

    seconds: float
    noise: float = 6.7e-4
    batch: int = 1
    rate: float = 1e-3
    seed: int = 0


@dataclass(frozen=True)
class GraphWindow:
    """Positions (N, H + 1, D) of consecutive frames, the present one last, and those of the next frame, (N, D)."""

    history: Tensor
    following: Tensor
    around: Neighbours

    def with_noise(self, noise: float, generator: torch.Generator) -> GraphWindow:
        """The same with a random walk on the positions, whose last velocity has noise of this standard deviation.

        The next positions are shifted like the present ones, so that the acceleration takes the noise back.
        """
        steps = self.history.shape[1] - 1
        shape = (len(self.history), steps, self.history.shape[2])
        velocity = torch.randn(shape, generator=generator).mul(noise / math.sqrt(steps)).cumsum(1)
        walk = torch.cat([torch.zeros_like(self.history[:, :1]), velocity.cumsum(1)], dim=1)
        return GraphWindow(self.history + walk, self.following + walk[:, -1], self.around)

    @property
    def acceleration(self) -> Tensor:
        """(N, D) from the last velocity seen to the next, in length per frame squared."""
        return self.following - 2 * self.history[:, -1] + self.history[:, -2]


def window_at(recording: Recording, frame: int) -> GraphWindow:
    """The window whose present frame is `frame` >= 1; velocities of before the recording are as its first one."""
    frames = recording.frames[max(0, frame - HISTORY) : frame + 1].transpose(0, 1)
    around = Neighbours(recording.material, recording.obstacle, recording.gravity)
    return GraphWindow(extend_back(frames, HISTORY + 1), recording.frames[frame + 1], around)


def draw_window(recordings: Sequence[Recording], generator: torch.Generator) -> GraphWindow:
    """A window of any recording and frame, all frames equally likely."""
    recording = recordings[int(torch.randint(len(recordings), (), generator=generator))]
    return window_at(recording, int(torch.randint(1, len(recording.frames) - 1, (), generator=generator)))


def calibrate(simulator: GraphSimulator, recordings: Sequence[Recording], noise: float, seed: int) -> None:
    """Set the simulator's statistics to those of noisy windows."""
    generator = torch.Generator().manual_seed(seed)
    windows = [draw_window(recordings, generator) for _ in range(SAMPLES)]
    velocity = torch.cat([window.history[:, -1] - window.history[:, -2] for window in windows])
    acceleration = torch.cat([window.acceleration for window in windows])
    for name, values in (("velocity", velocity), ("acceleration", acceleration)):
        getattr(simulator, f"{name}_mean").copy_(values.mean(0))
        spread = (values.var(0, correction=0) + noise**2).sqrt()
        getattr(simulator, f"{name}_std").copy_(spread.clamp(min=1e-9))


def loss_of(simulator: GraphSimulator, window: GraphWindow) -> Tensor:
    """Mean squared error of the normalised accelerations."""
    target = (window.acceleration - simulator.acceleration_mean) / simulator.acceleration_std
    loss: Tensor = (simulator(window.history, window.around) - target).square().mean()
    return loss


@torch.no_grad()
def validation_loss(simulator: GraphSimulator, recordings: Sequence[Recording], noise: float) -> float:
    """Mean loss over the same noisy windows whenever it is called."""
    generator = torch.Generator().manual_seed(1)
    windows = [draw_window(recordings, generator) for _ in range(VALIDATED)]
    return sum(float(loss_of(simulator, window.with_noise(noise, generator))) for window in windows) / VALIDATED


class GraphTrainer:
    """A training of a graph simulator, in place; `spent` are its seconds by the clock, of training alone."""

    def __init__(
        self,
        simulator: GraphSimulator,
        recordings: Sequence[Recording],
        settings: Training,
        clock: Callable[[], float] = time.process_time,
    ) -> None:
        calibrate(simulator, recordings, settings.noise, settings.seed)
        self.simulator, self.settings = simulator, settings
        self._recordings, self._clock = recordings, clock
        self._optimizer = torch.optim.Adam(simulator.parameters(), lr=settings.rate)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self.spent, self.steps = 0.0, 0

    def step(self) -> None:
        """Take one step; a DataError if the loss becomes non-finite."""
        start, settings, self.steps = self._clock(), self.settings, self.steps + 1
        rate = settings.rate * DECAY ** (self.spent / settings.seconds) * min(1.0, self.steps / WARM_UP)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self._optimizer.zero_grad()
        for _ in range(settings.batch):
            window = draw_window(self._recordings, self._generator).with_noise(settings.noise, self._generator)
            loss = loss_of(self.simulator, window) / settings.batch
            if not bool(loss.isfinite()):
                raise DataError("The loss of a graph simulator is not finite: lower the learning rate.")
            loss.backward()
        self._optimizer.step()
        self.spent += self._clock() - start

    def state_dict(self) -> dict[str, Any]:
        """All that a training goes on from: weights, optimizer, random state, time and steps."""
        return {
            "simulator": self.simulator.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "spent": self.spent,
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        self.simulator.load_state_dict(state["simulator"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        self.spent, self.steps = state["spent"], state["steps"]


def save(path: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain data."""
    with atomic_write(path) as part:
        torch.save(content, part)


def converged(curve: Sequence[tuple[float, float]]) -> bool:
    """Whether more training would not have changed much, see `STEADY`, by (minutes, validation loss)."""
    halfway = [loss for minutes, loss in curve if minutes <= curve[-1][0] / 2]
    return bool(halfway) and curve[-1][1] >= (1 - STEADY) * halfway[-1]


class GraphPredictor:
    """A trained graph simulator as a predictor of `nmpm trade`, named by its weights and its training."""

    def __init__(self, simulator: GraphSimulator, curve: Sequence[tuple[float, float]]) -> None:
        self.simulator = simulator
        steady = "" if converged(curve) else ", not converged"
        self.name = f"GNS {weights_digest(simulator.state_dict())[:12]}, {curve[-1][0]:.3g} min of training{steady}"

    def __call__(self, particles: Particles, frames: int) -> Tensor:
        return self.simulator.rollout(particles, frames)


def load(scene: Scene, path: str) -> GraphPredictor:
    """The predictor of a file that `main` wrote; a ConfigError if it was trained for other scenes."""
    content = torch.load(path, weights_only=True)
    trained = Scene.from_dict(content["scene"])
    if differing := trained.differences(scene):
        raise ConfigError(f"{path} was trained for other scenes: {', '.join(differing)} differ.")
    simulator = GraphSimulator(trained, content["width"]).eval()
    simulator.load_state_dict(content["weights"])
    return GraphPredictor(simulator, content["curve"])


def main() -> None:
    """Train and write what the command line asks for."""
    chosen = _parser().parse_args()
    torch.manual_seed(chosen.seed)
    folder = ensure(chosen.dataset, {"train": chosen.trajectories, "valid": 2, "test": 0})
    scene = infer_scene(folder)
    training, validation = (_recordings(folder, scene, split) for split in ("train", "valid"))
    simulator = GraphSimulator(scene, chosen.width)
    settings = Training(60 * max(chosen.minutes), chosen.noise, chosen.batch, chosen.rate, chosen.seed)
    trainer, stored = GraphTrainer(simulator, training, settings), chosen.out / "training.pt"
    curve: list[tuple[float, float]] = []
    if stored.is_file():
        state = torch.load(stored, weights_only=True)
        curve = state.pop("curve")
        trainer.load_state_dict(state)
    checks = {max(chosen.minutes) * (i + 1) / CHECKS for i in range(CHECKS)}
    due = sorted(minutes for minutes in {*chosen.minutes, *checks} if 60 * minutes > trainer.spent)
    while trainer.spent < settings.seconds:
        trainer.step()
        while due and trainer.spent >= 60 * due[0]:
            minutes = due.pop(0)
            curve.append((minutes, validation_loss(simulator, validation, chosen.noise)))
            sys.stdout.write(f"{minutes:.3g} min, {trainer.steps} steps: loss {curve[-1][1]:.4f}\n")
            sys.stdout.flush()
            if minutes in chosen.minutes:
                written = {"scene": scene.to_dict(), "width": chosen.width, "weights": simulator.state_dict()}
                save(chosen.out / f"minutes-{minutes:g}.pt", written | {"curve": curve})
            save(stored, trainer.state_dict() | {"curve": curve})


def _recordings(folder: Path, scene: Scene, split: str) -> list[Recording]:
    recordings = SplitRecordings(Split(folder / f"{split}.h5"), read_metadata(folder), Reading(scene))
    return [recordings[index] for index in range(len(recordings))]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("dataset", choices=preset_names())
    add("--minutes", type=float, nargs="+", default=[2.0, 5.0, 10.0], help="written then; the last ends")
    add("--trajectories", type=int, default=40, help="to train on")
    add("--width", type=int, default=32, help="of latent vectors; the paper's is 128")
    add("--batch", type=int, default=1)
    add("--rate", type=float, default=1e-3)
    add("--noise", type=float, default=6.7e-4, help="of the last velocity, in length per frame")
    add("--seed", type=int, default=0)
    add("--out", type=Path, default=Path("runs/gns"))
    return parser


if __name__ == "__main__":
    main()
