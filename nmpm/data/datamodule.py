"""Trajectories for Lightning: windows to train on, whole trajectories to evaluate on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from lightning.pytorch import LightningDataModule

from nmpm.data.loading.buffer import RecordingProvider, TrajectoryBuffer
from nmpm.data.loading.evaluation import EvaluationLoader
from nmpm.data.loading.sources import DataSource, EmbeddedSource, FolderSource, HubSource, SimulatedSource, StatedFacts
from nmpm.data.loading.window_plan import PlanStart, WindowPlan
from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.scene import Boundary, Scene

SourceName = Literal["disk", "simulate", "hub"]

_GPU_SHARE = 0.25  # of the free memory; the rest is for the model


@dataclass(frozen=True)
class _BatchHistory:
    """How training batches are cut from the plan: from where on, and of what size. Kept in checkpoints."""

    start: PlanStart
    batch_size: int
    world: int


class TrajectoryDataModule(LightningDataModule):
    """Recorded or simulated trajectories, as `Window` batches.

    Training batches come without end (give the Trainer `max_steps`), each of windows of horizon + 2 frames, and go on
    where training stopped when a checkpoint is resumed, with another number of processes or batch size too. Validation,
    test and prediction batches hold whole trajectories, each once over all ranks; prediction uses the test split.

    Args:
        path: A dataset: a folder in the native layout, or anything that `nmpm convert` reads, converted on first use.
        name: EmbeddedSource dataset, simulated on first use; either this or `path`.
        source: "disk"; or "simulate" to train on trajectories of `name` fresh from the simulator, never written and
            never seen twice; or "hub" for the dataset `name` of the Hugging Face hub's `iSach/NeuralMPM`.
        horizon: Frames to predict in a training window: frames per bundle times bundles unrolled.
        batch_size: Training windows per batch and rank.
        buffer_size: Training trajectories held in memory at a time; up to three times as many while others are read.
        passes: How often the windows of a buffer are seen, on average, before the next buffer.
        emphasis: Share of the training windows that is drawn in proportion to the motion in them, in [0, 1]; the rest
            is drawn evenly. Worth it where recordings end in long rest.
        seed: Order of the training windows.
        family: What the type ids in recorded data mean where its metadata does not say: "deepmind", "lagrangebench",
            "jax-sph".
        gravity: Acceleration in length/s² per axis, instead of that in the metadata of recorded data.
        boundary: "wall" or "periodic" per axis, likewise.
        bounds: (lower, upper) per axis, likewise.
        limit_eval: Validate on the first so many trajectories only.
        eval_batch_size: Trajectories per evaluation batch, of equal length each.
        generate: Options for the simulation of `name`: `counts` (trajectories per split), `frames`, `seed`, `workers`.

    Raises:
        ConfigError: if not exactly one of `path` and `name` is given, or a number is not positive.
    """

    def __init__(
        self,
        path: str | None = None,
        name: str | None = None,
        source: SourceName = "disk",
        horizon: int = 16,
        batch_size: int = 16,
        buffer_size: int = 16,
        passes: float = 4,
        emphasis: float = 0.0,
        seed: int = 0,
        family: str | None = None,
        gravity: list[float] | None = None,
        boundary: list[Boundary] | None = None,
        bounds: list[tuple[float, float]] | None = None,
        limit_eval: int | None = None,
        eval_batch_size: int = 8,
        generate: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        stated = {"family": family, "gravity": gravity, "boundary": boundary, "bounds": bounds}
        _check_source(path, name, source, stated, generate)
        for key, value in (("horizon", horizon), ("eval_batch_size", eval_batch_size), ("limit_eval", limit_eval)):
            if value is not None and value < 1:
                raise ConfigError(f"{key} = {value} must be at least 1.")
        self.data_source = _make_source(path, name, source, StatedFacts(**stated), dict(generate or {}))  # type: ignore[arg-type]  # (a dict of mixed types)
        self.horizon, self.batch_size, self.seed = horizon, batch_size, seed
        self.buffer_size, self.passes, self.emphasis = buffer_size, passes, emphasis
        self.limit_eval, self.eval_batch_size = limit_eval, eval_batch_size
        self._course: _BatchHistory | None = None

    def __str__(self) -> str:
        # Lightning's own would go through the endless training batches.
        return f"{type(self).__name__}({self.data_source}, horizon={self.horizon}, batch_size={self.batch_size})"

    @property
    def scene(self) -> Scene:
        """The scene of the dataset; an embedded one need not have been simulated for it.

        Raises:
            DataError: if recorded files are missing or wrong.
            ConfigError: if there is no such embedded dataset.
        """
        return self.data_source.scene

    @property
    def description(self) -> str:
        """What the data are, in words: simulated data are named so."""
        return self.data_source.description

    def prepare_data(self) -> None:
        """Simulates, fetches or converts the dataset on first use, in one process."""
        _ = self.data_source.folder

    def setup(self, stage: str) -> None:
        """Forgets an earlier training, unless this one goes on with it."""
        if stage == "fit" and not self.batches_seen:
            self._course = None

    def state_dict(self) -> dict[str, Any]:
        """How the batches seen so far were cut; how many they are is in the Trainer's own progress."""
        return asdict(self._course) if self._course is not None else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes up the training of a checkpoint."""
        self._course = _BatchHistory(PlanStart(**state["start"]), state["batch_size"], state["world"])

    def train_dataloader(self) -> TrainingLoader:
        """Endless batches of training windows, from the first one on that was not seen before a resumed checkpoint."""
        _, world = self.ranks
        course = self._course or _BatchHistory(PlanStart(), self.batch_size, world)
        source, plan = self.data_source.training(
            self.horizon + 2,
            batch_size=self.batch_size,
            buffer_size=self.buffer_size,
            passes=self.passes,
            seed=self.seed,
            emphasis=self.emphasis,
            start=course.start,
        )
        plan = plan.resume_after(self.batches_seen, course.batch_size, course.world, world)
        self._course = _BatchHistory(plan.start, self.batch_size, world)
        return TrainingLoader(TrajectoryBuffer(source, plan, self.buffer_device(source, plan)), self)

    def buffer_device(self, source: RecordingProvider, plan: WindowPlan) -> torch.device:
        """Where the buffer is held: on the trainer's GPU if that has room, else in the processor's memory."""
        device = self.trainer.strategy.root_device if self.trainer is not None else torch.device("cpu")
        if device.type != "cuda":
            return torch.device("cpu")
        free, _ = torch.cuda.mem_get_info(device)
        needed = 2 * min(plan.buffer_size, len(plan.frames)) * source.max_bytes
        return device if needed <= _GPU_SHARE * free else torch.device("cpu")

    def val_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the valid split, or the first `limit_eval` of them."""
        return self._evaluation("valid", self.limit_eval)

    def test_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the test split."""
        return self._evaluation("test")

    def predict_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the test split."""
        return self._evaluation("test")

    def _evaluation(self, name: str, limit: int | None = None) -> EvaluationLoader:
        rank, world = self.ranks
        return EvaluationLoader(self.data_source.recordings(name), self.eval_batch_size, limit, rank, world)

    @property
    def ranks(self) -> tuple[int, int]:
        """This process's number, and how many there are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer is not None else (0, 1)

    @property
    def batches_seen(self) -> int:
        """How many training batches this rank has finished, over all epochs and interruptions."""
        if self.trainer is None:
            return 0
        # Only `processed` is right in every checkpoint: `ready` counts a batch that was interrupted, `completed`
        # misses the one after which the checkpoint was written.
        total = self.trainer.fit_loop.epoch_loop.batch_progress.total
        return int(total.processed)  # type: ignore[attr-defined]  # (of batches)


class TrainingLoader:
    """The training batches from where training stands, each time it is iterated.

    Args:
        buffer: Gives the batches.
        owner: Knows where training stands.
    """

    def __init__(self, buffer: TrajectoryBuffer, owner: TrajectoryDataModule) -> None:
        self.buffer, self.owner = buffer, owner

    def __iter__(self) -> Iterator[Window]:
        return self.buffer.batches(self.owner.batches_seen, *self.owner.ranks)

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the Trainer's own progress says where to go on. That this exists tells Lightning so."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Has nothing to restore."""


def _make_source(
    path: str | None, name: str | None, source: str, stated: StatedFacts, generate: dict[str, Any]
) -> DataSource:
    if path is not None:
        return FolderSource(Path(path), stated)
    named: dict[str, Callable[[str], DataSource]] = {
        "disk": lambda known: EmbeddedSource(known, generate),
        "simulate": lambda known: SimulatedSource(known, generate),
        "hub": lambda known: HubSource(Path(known), stated),
    }
    return named[source](str(name))


def _check_source(
    path: str | None, name: str | None, source: str, stated: Mapping[str, Any], generate: Mapping[str, Any] | None
) -> None:
    if (path is None) == (name is None):
        raise ConfigError(
            f"Give either a dataset's `path` or the `name` of an embedded one; got path = {path}, name = {name}."
        )
    if source not in get_args(SourceName):
        raise ConfigError(f"source = {source} is not one of {', '.join(get_args(SourceName))}.")
    if path is not None and source != "disk":
        raise ConfigError(f"source = {source} needs the `name` of a dataset, not the path {path}.")
    recorded = path is not None or source == "hub"
    given = {"generate": generate} if recorded else stated
    wrong = [key for key, value in given.items() if value is not None]
    if wrong:
        kind = f"recorded data ({path or name})" if recorded else f"the simulated dataset {name}"
        raise ConfigError(f"{', '.join(wrong)} cannot be combined with {kind}; leave it out.")
