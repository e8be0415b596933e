"""Training of graph simulators: one step ahead, with noise on the positions seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nmpm.data.loading.recording import Recording
from nmpm.errors import ConfigError, DataError
from nmpm.evaluation.gns.simulator import GraphSimulator, Surroundings, extend_back

_SAMPLES = 200  # windows from which statistics are computed


@dataclass(frozen=True)
class GraphTraining:
    """How a graph simulator is trained.

    Args:
        seconds: Of the schedule, by the clock; training stops then.
        noise: Standard deviation of the last velocity's noise, in length per frame; the paper's.
        batch: Windows of a step.
        rate: Adam's first learning rate; it falls exponentially by `decay` over the schedule.
        decay: Last learning rate over the first.
        warmup: Steps over which the rate rises.
        seed: Of windows and noise.

    Raises:
        ConfigError: if a number is out of range.
    """

    seconds: float
    noise: float = 6.7e-4
    batch: int = 2
    rate: float = 1e-3
    decay: float = 0.01
    warmup: int = 50
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("seconds", "batch", "rate", "decay"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} = {getattr(self, name)} of a graph training must be positive and finite.")


@dataclass(frozen=True)
class GraphWindow:
    """Consecutive frames of one scene.

    Args:
        history: (N, H + 1, D) positions, the present ones last.
        following: (N, D) positions of the next frame.
        around: What does not move with them.
    """

    history: Tensor
    following: Tensor
    around: Surroundings

    def with_noise(self, noise: float, generator: torch.Generator) -> GraphWindow:
        """The same with a random walk on the positions, whose last velocity has noise of this standard deviation.

        The next positions are shifted like the present ones: their velocity is the true one, so that the acceleration
        to be predicted takes the noise back.
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


def window_at(recording: Recording, frame: int, history: int) -> GraphWindow:
    """The window whose present frame is `frame` >= 1; velocities of before the recording are as its first one."""
    first = max(0, frame - history)
    frames = recording.frames[first : frame + 1].transpose(0, 1)
    around = Surroundings(recording.material, recording.obstacle, recording.gravity)
    return GraphWindow(extend_back(frames, history + 1), recording.frames[frame + 1], around)


def draw_window(recordings: Sequence[Recording], history: int, generator: torch.Generator) -> GraphWindow:
    """A window of any recording and frame, all frames alike."""
    recording = recordings[int(torch.randint(len(recordings), (), generator=generator))]
    last = len(recording.frames) - 1
    return window_at(recording, int(torch.randint(1, last, (), generator=generator)), history)


def calibrate(simulator: GraphSimulator, recordings: Sequence[Recording], noise: float, seed: int) -> None:
    """Set the simulator's statistics to those of noisy windows."""
    generator = torch.Generator().manual_seed(seed)
    windows = [draw_window(recordings, simulator.recipe.history, generator) for _ in range(_SAMPLES)]
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
def validation_loss(simulator: GraphSimulator, recordings: Sequence[Recording], noise: float, count: int = 16) -> float:
    """Mean loss over the same noisy windows whenever it is called."""
    generator = torch.Generator().manual_seed(1)
    windows = [draw_window(recordings, simulator.recipe.history, generator) for _ in range(count)]
    return sum(float(loss_of(simulator, window.with_noise(noise, generator))) for window in windows) / count


def train(
    simulator: GraphSimulator,
    recordings: Sequence[Recording],
    settings: GraphTraining,
    clock: Callable[[], float] = time.process_time,
) -> Iterator[float]:
    """Train in place; yields after each step the seconds spent, of training alone.

    Args:
        simulator: To train; its statistics are calibrated first.
        recordings: Of at least 3 frames.
        settings: Length, noise, rates.
        clock: Measures `settings.seconds`: the process' CPU time when left out.

    Raises:
        DataError: if there are no recordings, or the loss becomes non-finite.
    """
    if not recordings:
        raise DataError("A graph simulator needs at least one recording to train on.")
    calibrate(simulator, recordings, settings.noise, settings.seed)
    optimizer = torch.optim.Adam(simulator.parameters(), lr=settings.rate)
    generator = torch.Generator().manual_seed(settings.seed)
    spent, step = 0.0, 0
    while spent < settings.seconds:
        start, step = clock(), step + 1
        rate = settings.rate * settings.decay ** (spent / settings.seconds) * min(1.0, step / max(settings.warmup, 1))
        for group in optimizer.param_groups:
            group["lr"] = rate
        _step(simulator, recordings, settings, optimizer, generator)
        spent += clock() - start
        yield spent


def _step(
    simulator: GraphSimulator,
    recordings: Sequence[Recording],
    settings: GraphTraining,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
) -> None:
    optimizer.zero_grad()
    for _ in range(settings.batch):
        window = draw_window(recordings, simulator.recipe.history, generator).with_noise(settings.noise, generator)
        loss = loss_of(simulator, window) / settings.batch
        if not bool(loss.isfinite()):
            raise DataError("The loss of a graph simulator is not finite: lower the learning rate.")
        loss.backward()
    optimizer.step()
