"""Lightning datamodule: windows for training, whole trajectories for evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from lightning.pytorch import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn

from nmpm._support.plain_data import from_plain
from nmpm.data.batches import PlanStart, RecordingProvider, TrajectoryBuffer, WindowPlan
from nmpm.data.convert import Options
from nmpm.data.format import split_paths
from nmpm.data.recordings import EvaluationLoader, SplitRecordings
from nmpm.data.sources import DataSource, FolderSource, HubSource, hold_out
from nmpm.data.windows import check_observed, pin_for
from nmpm.errors import ConfigError
from nmpm.particles import Window
from nmpm.scene import Boundary, Reading, Scene

SourceName = Literal["disk", "simulate", "hub"]

_OPEN = "???"  # OmegaConf's for a value that is still to be given
_GPU_SHARE = 0.25  # of the free GPU memory that the buffer may use; the rest is for the model


@dataclass(frozen=True)
class _BatchHistory:
    """Where in the plan the current batches start, and their size; saved in checkpoints."""

    start: PlanStart
    batch_size: int
    world: int


class TrajectoryDataModule(LightningDataModule):
    """Recorded or simulated trajectories, as `Window` batches.

    Training batches are endless (give the Trainer `max_steps`), of windows with horizon + 2 frames. A resumed training
    continues with the batch that comes next, also with another number of processes or batch size. Validation, test and
    prediction batches hold whole trajectories, each on exactly one rank; prediction uses the test split. Batches for a
    GPU are in pinned memory and copied asynchronously.

    Args:
        path: A dataset: a folder in the native layout, or anything that `nmpm convert` reads, converted on first use.
        name: Embedded dataset, simulated on first use. Ignored where `path` is given, as is `generate`, so that
            `--data.path` on the command line replaces both of a configuration.
        source: "disk"; or "simulate" to train on new trajectories of `name` from the simulator, which are not written
            and used in one buffer only; or "hub" for the dataset `name` of the Hugging Face hub's `iSach/NeuralMPM`.
        horizon: Frames to predict in a training window: frames per bundle times bundles unrolled.
        batch_size: Training windows per batch and rank.
        buffer_size: Training trajectories in memory at a time; up to three times as many while the next are read.
        passes: How often the windows of a buffer are drawn, on average, before the next buffer.
        emphasis: Fraction of the training windows that is drawn in proportion to the motion in them, in [0, 1]; the
            rest is drawn uniformly. Useful where recordings end with a long rest.
        openings: Fraction of the training windows that start in one of a trajectory's first 16 frames, in [0, 1]. Every
            rollout starts there, but only few of a trajectory's windows do.
        bucket_batches: Training batches in a row whose windows are sorted by their number of particles and dealt to
            them anew, so that a large scene does not make small ones pay for padding; 1 for none.
        seed: Seed of the order of the training windows.
        family: Meaning of the type ids in recorded data where its metadata does not state it: "deepmind",
            "lagrangebench", "jax-sph".
        gravity: Acceleration in length/s² per axis, where recorded data do not state it.
        boundary: "wall", "periodic" or "open" per axis, instead of that in the metadata of recorded data. Particles
            that leave the bounds of an open axis are gone.
        bounds: (lower, upper) per axis, likewise.
        fields: Names of fields that are inputs of the model, such as [temperature], instead of those that the metadata
            of recorded data declare; [] for none. Those that evolve are predicted.
        prescribed: Ids of the types in recorded data that are obstacles and move as recorded, such as [2] for a paddle.
        resample: Time between frames that the positions of recorded data are interpolated to, where theirs are uneven.
        smooth: Frames of local quadratic fits that replace measured positions, such as 5, against their noise; errors
            are then against the smoothed tracks.
        files: Patterns of the names of the files to read, separated by commas, where others lie beside them.
        limit_eval: Validate on the first `limit_eval` trajectories only.
        eval_batch_size: Trajectories per evaluation batch, of equal length each.
        generate: Options for the simulation of `name`: `counts` (trajectories per split), `frames`, `seed`, `workers`.
        reading: How the data are read for a model, see `nmpm.scene.Reading`, as plain data.

    Attributes:
        validated: How many trajectories, the first ones, validate in a training where `limit_eval` does not say it;
            None before that is decided, and for all. Kept in checkpoints.

    Raises:
        ConfigError: if neither `path` nor `name` is given, options contradict each other, or a number is not positive.
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
        openings: float = 0.0,
        bucket_batches: int = 1,
        seed: int = 0,
        family: str | None = None,
        gravity: list[float] | None = None,
        boundary: list[Boundary] | None = None,
        bounds: list[tuple[float, float]] | None = None,
        fields: list[str] | None = None,
        prescribed: list[int] | None = None,
        resample: float | None = None,
        smooth: int | None = None,
        files: str | None = None,
        limit_eval: int | None = None,
        eval_batch_size: int = 8,
        generate: dict[str, Any] | None = None,
        reading: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        facts = {"prescribed": prescribed, "bounds": bounds, "gravity": gravity, "boundary": boundary, "fields": fields}
        options = Options.of(facts | {"family": family, "resample": resample, "smooth": smooth, "files": files})
        self.data_source = _make_source(path, name, source, options, generate)
        if reading is not None:
            self.reading = from_plain(Reading, reading, "data.reading")
        for key, value in (("horizon", horizon), ("eval_batch_size", eval_batch_size), ("limit_eval", limit_eval)):
            if value is not None and value < 1:
                raise ConfigError(f"{key} = {value} must be at least 1.")
        self.horizon, self.batch_size, self.seed = horizon, batch_size, seed
        self.buffer_size, self.passes = buffer_size, passes
        self.emphasis, self.openings, self.bucket_batches = emphasis, openings, bucket_batches
        self.limit_eval, self.eval_batch_size = limit_eval, eval_batch_size
        self._provider: RecordingProvider | None = None
        self._history: _BatchHistory | None = None
        self.validated: int | None = None

    def __str__(self) -> str:
        # Lightning's default iterates over the endless training batches.
        return f"{type(self).__name__}({self.data_source}, horizon={self.horizon}, batch_size={self.batch_size})"

    @cached_property
    def reading(self) -> Reading:
        """How the data are read: as they are, until another is assigned; in its frames are windows and `horizon`."""
        return Reading(self.data_source.scene)

    @property
    def scene(self) -> Scene:
        """The scene of the dataset, as it is read; for an embedded dataset nothing is simulated."""
        return self.reading.scene

    def recordings(self, name: str) -> SplitRecordings:
        """The trajectories of the split "train", "valid" or "test"; raises a DataError if its file is missing."""
        return self.data_source.recordings(name, self.reading)

    @property
    def description(self) -> str:
        """The data in words; simulated data are called simulated."""
        return self.data_source.description

    def prepare_data(self) -> None:
        """Simulates, downloads or converts the dataset on first use, in one process."""
        _ = self.data_source.folder

    def setup(self, stage: str) -> None:
        """Resets the position in the plan, unless a checkpoint is resumed, and looks at all that a training reads.

        Raises:
            DataError: if a split cannot be evaluated, or not be read at the ends of its trajectories, or is missing.
        """
        if stage != "fit":
            return
        self._history = self._history if self.batches_seen else None
        present = split_paths(self.data_source.folder)
        if "valid" not in present and self.trainer is not None and self.trainer.enable_validation:
            self.data_source = hold_out(self.data_source)
        for name in present:
            recordings = self.recordings(name)
            recordings.check_ends()
            if name != "train":
                recordings.with_frames(3, "an evaluation")

    @property
    def has_test(self) -> bool:
        """Whether there is a test split."""
        return "test" in split_paths(self.data_source.folder)

    def state_dict(self) -> dict[str, Any]:
        """Start and size of the current batches; how many were used is in the Trainer's own progress."""
        return asdict(self._history) | {"validated": self.validated} if self._history is not None else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores start and size of the batches from a checkpoint, and for a training what it validates on."""
        self._history = _BatchHistory(PlanStart(**state["start"]), state["batch_size"], state["world"])
        if self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING:
            self.validated = state["validated"]

    def train_dataloader(self) -> TrainingLoader:
        """Endless batches of training windows; after a resumed checkpoint, those that come next."""
        _, world = self.ranks
        history = self._history
        if history is None or history.start.batch > self.batches_seen:  # (the batch-size finder starts over)
            history = _BatchHistory(PlanStart(), self.batch_size, world)
        check_observed(self.horizon, self.reading)
        self._provider, plan = self.data_source.training_data(
            self.horizon + 2,
            self.reading,
            batch_size=self.batch_size,
            buffer_size=self.buffer_size,
            passes=self.passes,
            seed=self.seed,
            emphasis=self.emphasis,
            openings=self.openings,
            bucket=self.bucket_batches,
            start=history.start,
        )
        plan = plan.resume_after(self.batches_seen, history.batch_size, history.world, world)
        return TrainingLoader(TrajectoryBuffer(self._provider, plan, self.buffer_device(self._provider, plan)), self)

    def begin_batches(self, plan: WindowPlan) -> None:
        """Remember, for checkpoints, that batches are of this plan from now on."""
        self._history = _BatchHistory(plan.start, plan.batch_size, self.ranks[1])

    @property
    def target_device(self) -> torch.device:
        """The device that batches are copied to: the trainer's, or the CPU without a trainer."""
        return self.trainer.strategy.root_device if self.trainer is not None else torch.device("cpu")

    def transfer_batch_to_device(self, batch: Window, device: torch.device, dataloader_idx: int) -> Window:  # noqa: ARG002
        """Copies a batch to a device; copies to a GPU do not block the host."""
        return batch.to(device, non_blocking=device.type == "cuda")

    def teardown(self, stage: str) -> None:  # noqa: ARG002
        """Stops simulations that are still running for the next buffer."""
        if self._provider is not None:
            self._provider.close()

    def buffer_device(self, provider: RecordingProvider, plan: WindowPlan) -> torch.device:
        """The device that holds the buffer: the trainer's GPU if it has enough free memory, else the CPU."""
        device = self.target_device
        if device.type != "cuda":
            return torch.device("cpu")
        free, _ = torch.cuda.mem_get_info(device)
        needed = 2 * min(plan.buffer_size, len(plan.frames)) * provider.max_bytes
        return device if needed <= _GPU_SHARE * free else torch.device("cpu")

    def val_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the valid split, or the first `limit_eval` or `validated` of them."""
        return self._evaluation("valid", self.limit_eval or self.validated)

    def test_dataloader(self) -> EvaluationLoader:
        """Whole trajectories of the test split."""
        return self._evaluation("test")

    predict_dataloader = test_dataloader

    def _evaluation(self, name: str, limit: int | None = None) -> EvaluationLoader:
        return EvaluationLoader(self.recordings(name), self.eval_batch_size, limit, *self.ranks, self.target_device)

    @property
    def ranks(self) -> tuple[int, int]:
        """Index of this process, and the number of processes."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer is not None else (0, 1)

    @property
    def batches_seen(self) -> int:
        """Number of training batches that this rank has finished, over all epochs and resumed runs."""
        if self.trainer is None:
            return 0
        # Only `processed` is right in every checkpoint: `ready` counts a batch that was interrupted, `completed`
        # misses the batch after which the checkpoint was written.
        return int(self.trainer.fit_loop.epoch_loop.batch_progress.total.processed)  # type: ignore[attr-defined]


class TrainingLoader:
    """Iterates over the batches of a buffer, from the current batch of the owner's trainer on."""

    def __init__(self, buffer: TrajectoryBuffer, owner: TrajectoryDataModule) -> None:
        self.buffer, self.owner = buffer, owner

    def __iter__(self) -> Iterator[Window]:
        if self.buffer.plan.start.batch > self.owner.batches_seen:
            self.buffer = self.owner.train_dataloader().buffer
        self.owner.begin_batches(self.buffer.plan)
        first = self.owner.batches_seen
        if repeated := int(getattr(self.owner.trainer, "overfit_batches", 0)):
            first %= repeated  # the same batches again in each epoch
        batches = self.buffer.batches(first, *self.owner.ranks)
        return pin_for(self.owner.target_device, batches) if self.buffer.device.type == "cpu" else batches

    def state_dict(self) -> dict[str, Any]:
        """Empty: the Trainer's own progress suffices. Lightning takes a loader with this method for resumable."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


def _make_source(
    path: str | None, name: str | None, source: SourceName, options: Options, generate: Mapping[str, Any] | None
) -> DataSource:
    """The source that the arguments of `TrajectoryDataModule` mean; a ConfigError if they contradict each other."""
    if path == _OPEN and name is None:
        raise ConfigError("data.path is not set, the configuration leaves it open (???): give --data.path FOLDER.")
    if path is None and name is None:
        raise ConfigError(
            "Neither data.path nor data.name is set: give --data.path FOLDER, or --data.name and an embedded dataset"
            " (nmpm simulate --list)."
        )
    if source not in get_args(SourceName):
        raise ConfigError(f"source = {source} is not one of {', '.join(get_args(SourceName))}.")
    if path is not None and path != _OPEN:
        if source != "disk":
            raise ConfigError(
                f"source = {source} needs the `name` of a dataset, not the path {path}; for the path, --data.source"
                " disk."
            )
        return FolderSource(Path(path), options)
    if source == "hub":
        _refuse({"generate": generate}, f"the published dataset {name}")
        return HubSource(Path(str(name)), options)
    _refuse(vars(options), f"the simulated dataset {name}")
    from nmpm.data.simulated_sources import EmbeddedSource, SimulatedSource  # imports simulators

    kind = SimulatedSource if source == "simulate" else EmbeddedSource
    return kind(str(name), dict(generate or {}))


def _refuse(arguments: Mapping[str, Any], data: str) -> None:
    wrong = [key for key, value in arguments.items() if value is not None]
    if wrong:
        mend = " ".join(f"--data.{key} null" for key in wrong)
        raise ConfigError(f"{', '.join(wrong)} cannot be combined with {data}; leave it out: {mend}.")
