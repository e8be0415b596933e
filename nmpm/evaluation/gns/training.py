"""Training of graph simulators: one step ahead, with noise on the positions seen."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
    """A window of any recording and frame, all frames equally likely."""
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


class GraphTrainer:
    """A training of a graph simulator, in place; its statistics are calibrated first.

    Args:
        simulator: To train.
        recordings: Of at least 3 frames.
        settings: Length, noise, rates.
        clock: Measures `settings.seconds`: the process' CPU time when left out.

    Attributes:
        spent: Seconds so far, of training alone.
        steps: Taken so far.

    Raises:
        DataError: if there are no recordings.
    """

    def __init__(
        self,
        simulator: GraphSimulator,
        recordings: Sequence[Recording],
        settings: GraphTraining,
        clock: Callable[[], float] = time.process_time,
    ) -> None:
        if not recordings:
            raise DataError("A graph simulator needs at least one recording to train on.")
        calibrate(simulator, recordings, settings.noise, settings.seed)
        self.simulator, self.settings = simulator, settings
        self._recordings, self._clock = recordings, clock
        self._optimizer = torch.optim.Adam(simulator.parameters(), lr=settings.rate)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self.spent, self.steps = 0.0, 0

    @property
    def done(self) -> bool:
        """Whether the schedule is over."""
        return self.spent >= self.settings.seconds

    def step(self) -> None:
        """Take one step.

        Raises:
            DataError: if the loss becomes non-finite.
        """
        start, settings, self.steps = self._clock(), self.settings, self.steps + 1
        fallen = settings.decay ** (self.spent / settings.seconds)
        for group in self._optimizer.param_groups:
            group["lr"] = settings.rate * fallen * min(1.0, self.steps / max(settings.warmup, 1))
        self._descend()
        self.spent += self._clock() - start

    def _descend(self) -> None:
        batch, noise = self.settings.batch, self.settings.noise
        self._optimizer.zero_grad()
        for _ in range(batch):
            window = draw_window(self._recordings, self.simulator.recipe.history, self._generator)
            loss = loss_of(self.simulator, window.with_noise(noise, self._generator)) / batch
            if not bool(loss.isfinite()):
                raise DataError("The loss of a graph simulator is not finite: lower the learning rate.")
            loss.backward()
        self._optimizer.step()

    def state_dict(self) -> dict[str, Tensor]:
        """All that a training goes on from, as tensors: weights, optimizer, random state, time and steps."""
        state = {f"simulator.{name}": values for name, values in self.simulator.state_dict().items()}
        for index, entries in self._optimizer.state_dict()["state"].items():
            state |= {f"optimizer.{index}.{name}": values for name, values in entries.items()}
        state["generator"] = self._generator.get_state()
        state["spent"] = torch.tensor(self.spent, dtype=torch.float64)
        state["steps"] = torch.tensor(self.steps)
        return state

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state of `state_dict`.

        Raises:
            DataError: if it is that of another simulator.
        """
        moments: dict[int, dict[str, Tensor]] = {}
        try:
            for name, values in _part(state, "optimizer").items():
                index, _, entry = name.partition(".")
                moments.setdefault(int(index), {})[entry] = values
            self.simulator.load_state_dict(_part(state, "simulator"))
            groups = self._optimizer.state_dict()["param_groups"]
            self._optimizer.load_state_dict({"state": moments, "param_groups": groups})
            self._generator.set_state(state["generator"])
            self.spent, self.steps = float(state["spent"]), int(state["steps"])
        except (KeyError, ValueError, RuntimeError) as error:
            raise DataError(f"The stored state is not of this training of a graph simulator: {error}") from error


def _part(state: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key.removeprefix(f"{name}."): values for key, values in state.items() if key.startswith(f"{name}.")}


def train(
    simulator: GraphSimulator,
    recordings: Sequence[Recording],
    settings: GraphTraining,
    clock: Callable[[], float] = time.process_time,
) -> Iterator[float]:
    """Train in place, see `GraphTrainer`; yields after each step the seconds spent."""
    trainer = GraphTrainer(simulator, recordings, settings, clock)
    while not trainer.done:
        trainer.step()
        yield trainer.spent
