"""Options of Lightning: each trains, or is refused in a line before the first step; `docs/lightning.md` lists them."""

import datetime
import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import lightning
import pytest
import torch
from lightning.fabric.connector import _PRECISION_INPUT_STR
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.pytorch import callbacks, loggers, profilers
from lightning.pytorch.plugins import AsyncCheckpointIO, precision
from lightning.pytorch.strategies import ModelParallelStrategy, StrategyRegistry
from lightning.pytorch.tuner import Tuner

from nmpm import EmulatorModule, TrajectoryDataModule
from nmpm.cli import main
from nmpm.errors import ConfigError
from nmpm.optimizers import SOAP
from nmpm.particles import Window
from nmpm.processors import FNO, TFNO, Axial, ConvNeXt, UNet
from nmpm.training.checkpoints import load_module
from nmpm.transfer import Nearest, Quadratic

ROOT = Path(__file__).parents[2]
TINY = UNet(width=4, depth=1, perceptron=(4,))
Verdict = Literal["works", "refused", "elsewhere"]
WORDS = {"works": "works", "refused": "refused", "elsewhere": "not tested"}


@dataclass(frozen=True)
class Row:
    """A line of the page's tables, and the options of the Trainer that show it."""

    option: str
    value: str
    verdict: Verdict
    note: str = ""
    options: Callable[[Path], dict[str, Any]] | None = None
    error: str = ""
    """What a refusal says."""
    resume: bool = False
    slow: bool = False

    def __str__(self) -> str:
        return f"{self.option}: {self.value}" if self.value else self.option

    @property
    def line(self) -> str:
        verdict = WORDS[self.verdict] + (f": {self.note}" if self.note else "")
        return f"| `{self.option}` | {self.value} | {verdict} |"


def works(option: str, value: str = "", note: str = "", **kept: Any) -> Row:
    return Row(option, value, "works", note, **_options(kept))


def refused(option: str, value: str, note: str, error: str, **kept: Any) -> Row:
    return Row(option, value, "refused", note, error=error, **_options(kept))


def elsewhere(option: str, value: str, note: str) -> Row:
    return Row(option, value, "elsewhere", note)


def _options(kept: dict[str, Any]) -> dict[str, Any]:
    """The Trainer's options apart from those of the row; `make` makes them of a folder."""
    rows = {name: kept.pop(name) for name in ("resume", "slow") if name in kept}
    make = kept.pop("make", None)
    return rows | {"options": make or (lambda _: kept)}


def callback(
    name: str, verdict: Verdict = "works", note: str = "", error: str = "", value: str = "", **kept: Any
) -> Row:
    """A row of a callback; `arguments` are its own, the others the Trainer's."""
    arguments = kept.pop("arguments", {})
    rows = {key: kept.pop(key) for key in ("resume", "slow") if key in kept}

    def make(folder: Path) -> dict[str, Any]:
        logger = {"logger": loggers.CSVLogger(folder)} if kept.pop("logged", False) else {}
        given = {key: folder if value == "FOLDER" else value for key, value in arguments.items()}
        return {"callbacks": [getattr(callbacks, name)(**given)]} | logger | kept

    return Row(name, value, verdict, note, make, error, **rows)


EPOCHS = {"max_epochs": 2, "max_steps": -1, "limit_train_batches": 2, "val_check_interval": None,
          "check_val_every_n_epoch": 1}  # fmt: skip
ENDLESS = "batches are endless"
GPU = "needs a GPU, or several"
TABLES: dict[str, list[Row]] = {
    "Arguments of the Trainer": [
        works("accelerator", "cpu, auto", accelerator="auto"),
        elsewhere("accelerator", "cuda, gpu, mps", "Lightning says where there is none"),
        refused("accelerator", "tpu", "needs torch_xla, which the kernels are not for", "torch_xla", accelerator="tpu"),
        works("strategy", "", "see below", strategy="auto"),
        works("devices", "", "see [several GPUs](scaling.md)", devices=1),
        elsewhere("num_nodes", "", "see [several GPUs and clusters](scaling.md)"),
        works("precision", "", "see below", precision="32-true"),
        works("logger", "", "see below", logger=True),
        works("callbacks", "", "see below", callbacks=[]),
        works("fast_dev_run", "", "", fast_dev_run=2),
        works("max_epochs", "with `limit_train_batches`", **EPOCHS, resume=True),
        refused("max_epochs", "alone", f"{ENDLESS}", "has no end", max_epochs=2, max_steps=-1),
        works("min_epochs", "with `limit_train_batches`", **EPOCHS, min_epochs=1),
        refused("min_epochs", "alone", f"{ENDLESS}", "min_epochs=1 needs epochs that end", min_epochs=1),
        works("max_steps", "", "", max_steps=3, resume=True),
        works("min_steps", "with `limit_train_batches`", **EPOCHS, min_steps=2),
        refused("min_steps", "alone", f"{ENDLESS}", "min_steps=2 needs epochs that end", min_steps=2),
        works("max_time", "", "", max_time=datetime.timedelta(seconds=0.5), max_steps=-1),
        works("limit_train_batches", "a number", "ends epochs", limit_train_batches=2),
        refused("limit_train_batches", "a share", f"{ENDLESS}", "1.0", limit_train_batches=0.5),
        works("limit_val_batches", "", "", limit_val_batches=1),
        works("limit_test_batches", "", "", limit_test_batches=1),
        works("limit_predict_batches", "", "", limit_predict_batches=1),
        works("overfit_batches", "a number", "the same batches in each epoch", overfit_batches=2),
        refused("overfit_batches", "a share", f"{ENDLESS}", "IterableDataset", overfit_batches=0.5),
        works("val_check_interval", "a number of steps, a time", "", val_check_interval="00:00:00:01"),
        refused("val_check_interval", "a share", f"{ENDLESS}", "should be an integer", val_check_interval=0.5),
        works(
            "check_val_every_n_epoch", "", "None, so that `val_check_interval` counts steps of the training", **EPOCHS
        ),
        works("num_sanity_val_steps", "", "", num_sanity_val_steps=-1),
        works("log_every_n_steps", "", "", log_every_n_steps=1),
        works("enable_checkpointing", "", "False only from Python", enable_checkpointing=False),
        works("enable_progress_bar", "", "", enable_progress_bar=True),
        works("enable_model_summary", "", "", enable_model_summary=True),
        works("accumulate_grad_batches", "", "", accumulate_grad_batches=2, resume=True),
        works("gradient_clip_val", "", "", gradient_clip_val=1.0),
        works("gradient_clip_algorithm", "", "", gradient_clip_val=1.0, gradient_clip_algorithm="value"),
        works("deterministic", "", "", deterministic="warn"),
        works("benchmark", "", "", benchmark=True),
        works("inference_mode", "", "", inference_mode=False),
        works(
            "use_distributed_sampler",
            "",
            "without effect: batches are dealt to ranks by the data",
            use_distributed_sampler=False,
        ),
        works("profiler", "", "see below", profiler="simple"),
        works("detect_anomaly", "", "", detect_anomaly=True),
        works(
            "barebones",
            "",
            "only from Python: `nmpm fit` saves and logs",
            barebones=True,
            num_sanity_val_steps=None,
            logger=None,
            enable_progress_bar=None,
            enable_model_summary=None,
            enable_checkpointing=None,
        ),
        works(
            "plugins",
            "checkpoint I/O, cluster environments, precision",
            "",
            make=lambda _: {"plugins": [AsyncCheckpointIO(), LightningEnvironment()]},
            resume=True,
        ),
        works("sync_batchnorm", "", "without effect: networks here have no batch norm", sync_batchnorm=True),
        works("reload_dataloaders_every_n_epochs", "", "", reload_dataloaders_every_n_epochs=1, **EPOCHS),
        works("default_root_dir", "", "", make=lambda folder: {"default_root_dir": folder / "elsewhere"}),
        works("enable_autolog_hparams", "", "", enable_autolog_hparams=False),
        elsewhere("model_registry", "", "Lightning's own service"),
    ],
    "Precision": [
        works("32-true", "", "the default", precision="32-true", resume=True),
        works(
            "64-true",
            "",
            "data, transfers, network and loss; files are float32, and so are models loaded from checkpoints",
            precision="64-true",
            resume=True,
        ),
        works("bf16-mixed", "", "only the network computes in bfloat16", precision="bf16-mixed", resume=True),
        works("16-mixed", "", "only the network computes in float16", precision="16-mixed"),
        *(
            refused(
                name,
                "",
                "positions would be off by whole cells: bf16-mixed or 32-true",
                f"{name}.*bf16-mixed.*32-true",
                precision=name,
            )
            for name in ("bf16-true", "16-true")
        ),
        *(
            refused(
                name, "", "needs transformer_engine, which has no convolutions", "transformer_engine", precision=name
            )
            for name in ("transformer-engine", "transformer-engine-float16")
        ),
        works("DoublePrecision", "plugin", make=lambda _: {"plugins": precision.DoublePrecision()}),
        works("MixedPrecision", "plugin", make=lambda _: {"plugins": precision.MixedPrecision("bf16-mixed", "cpu")}),
        refused(
            "HalfPrecision",
            "plugin",
            "as 16-true",
            "positions in float16",
            make=lambda _: {"plugins": precision.HalfPrecision("16-true")},
        ),
        refused(
            "BitsandbytesPrecision",
            "plugin",
            "needs bitsandbytes, which has no convolutions",
            "bitsandbytes",
            make=lambda _: {"plugins": precision.BitsandbytesPrecision("nf4")},
        ),
    ],
    "Strategies": [
        works("auto, single_device", "", "", strategy="single_device"),
        elsewhere("ddp", "and its variants", "tests/training/test_distributed.py, also on CPUs"),
        elsewhere("ddp_spawn, ddp_fork, ddp_notebook", "", "work in notebooks; `nmpm fit` refuses them: ddp"),
        refused("fsdp, fsdp_cpu_offload", "without a GPU", GPU, "requires a GPU", strategy="fsdp"),
        refused("deepspeed", "and its stages", "needs deepspeed", "DeepSpeed", strategy="deepspeed"),
        refused(
            "ModelParallelStrategy",
            "",
            "networks here fit one device: ddp",
            "ModelParallelStrategy",
            make=lambda _: {"strategy": ModelParallelStrategy(), "devices": 1},
            slow=True,
        ),
        refused("xla, single_xla, single_tpu, xla_debug", "", "need torch_xla", "torch_xla", strategy="xla"),
    ],
    "Loggers": [
        works(
            "CSVLogger",
            "",
            "the default, with TensorBoardLogger",
            make=lambda folder: {"logger": [loggers.CSVLogger(folder), loggers.TensorBoardLogger(folder)]},
        ),
        works("TensorBoardLogger", make=lambda folder: {"logger": loggers.TensorBoardLogger(folder)}),
        works("False", logger=False),
        elsewhere(
            "WandbLogger", "", "works offline; online it needs an account, which is asked for before the first step"
        ),
        *(
            elsewhere(name, "", f"needs {package}: Lightning says so")
            for name, package in (("MLFlowLogger", "mlflow"), ("CometLogger", "comet-ml"), ("LitLogger", "litlogger"))
        ),
    ],
    "Profilers": [
        works("SimpleProfiler", make=lambda _: {"profiler": profilers.SimpleProfiler()}),
        works("AdvancedProfiler", make=lambda _: {"profiler": profilers.AdvancedProfiler()}),
        works("PyTorchProfiler", make=lambda folder: {"profiler": profilers.PyTorchProfiler(folder)}, slow=True),
        works("PassThroughProfiler", make=lambda _: {"profiler": profilers.PassThroughProfiler()}),
        refused(
            "XLAProfiler", "", "needs torch_xla", "torch_xla", make=lambda _: {"profiler": profilers.XLAProfiler()}
        ),
    ],
    "Callbacks": [
        callback(
            "EarlyStopping", value="valid/overall, train/loss", arguments={"monitor": "valid/overall"}, resume=True
        ),
        callback(
            "EarlyStopping",
            "refused",
            "names what is logged",
            "val_loss, which is not logged",
            value="another `monitor`",
            arguments={"monitor": "val_loss"},
        ),
        callback(
            "ModelCheckpoint",
            arguments={"monitor": "valid/overall", "save_last": True, "dirpath": "FOLDER"},
            resume=True,
        ),
        callback(
            "ModelCheckpoint",
            "refused",
            "names what is logged",
            "val_loss, which is not logged",
            value="another `monitor`",
            arguments={"monitor": "val_loss"},
        ),
        callback("OnExceptionCheckpoint", arguments={"dirpath": "FOLDER"}),
        callback("LearningRateMonitor", logged=True),
        callback(
            "LearningRateFinder",
            note="sets the optimizer's rate; on resuming, refused",
            arguments={"num_training_steps": 4},
        ),
        callback(
            "BatchSizeFinder",
            note="sets data.batch_size; on a CPU give `max_val`, as memory ends without an error; on resuming, refused",
            arguments={"max_val": 8, "steps_per_trial": 1},
        ),
        callback("GradientAccumulationScheduler", arguments={"scheduling": {0: 2}}, value="from epoch 0"),
        callback(
            "GradientAccumulationScheduler",
            "refused",
            f"{ENDLESS}: give `limit_train_batches`",
            "epoch 4 on needs epochs",
            arguments={"scheduling": {0: 2, 4: 3}},
            value="from later epochs",
        ),
        callback("EMAWeightAveraging", arguments={"use_buffers": False}, resume=True),
        callback("WeightAveraging", value="use_buffers=False", arguments={"use_buffers": False}, resume=True),
        callback(
            "WeightAveraging",
            "refused",
            "normalisation statistics have no average",
            "use_buffers=False",
            value="use_buffers=True",
        ),
        callback(
            "StochasticWeightAveraging",
            value="with epochs",
            arguments={"swa_lrs": 1e-3, "swa_epoch_start": 1},
            **EPOCHS,
        ),
        callback(
            "StochasticWeightAveraging",
            "refused",
            f"{ENDLESS}: give `limit_train_batches`, or EMAWeightAveraging",
            "StochasticWeightAveraging needs epochs",
            value="without",
            arguments={"swa_lrs": 1e-3},
        ),
        callback(
            "ModelPruning",
            "refused",
            "fewer channels do more",
            "ModelPruning.*fewer channels",
            arguments={"pruning_fn": "l1_unstructured"},
        ),
        callback("BackboneFinetuning", "refused", "emulators have no backbone: EmulatorModule.of", "EmulatorModule.of"),
        elsewhere("BaseFinetuning", "", "to be derived from"),
        elsewhere("BasePredictionWriter", "", "to be derived from; `nmpm predict` has one"),
        elsewhere("Callback", "", "to be derived from"),
        elsewhere("Checkpoint", "", "to be derived from"),
        elsewhere("ProgressBar", "", "to be derived from"),
        callback("LambdaCallback", arguments={"on_train_start": lambda *_: None}),
        callback("DeviceStatsMonitor", logged=True),
        callback(
            "ThroughputMonitor",
            note="only from Python, as it needs a function",
            logged=True,
            arguments={"batch_size_fn": lambda window: len(window.frames)},
        ),
        callback("Timer", note="from `nmpm fit` give `max_time`", arguments={"duration": "00:00:01:00"}, resume=True),
        callback("SpikeDetection", note="on resuming, refused, by an error of Lightning's"),
        callback("ModelSummary", enable_model_summary=True),
        callback("RichModelSummary", enable_model_summary=True),
        callback("RichProgressBar", enable_progress_bar=True),
        callback("TQDMProgressBar", enable_progress_bar=True),
    ],
}
ROWS = [(group, row) for group, rows in TABLES.items() for row in rows if row.options is not None]


def table(rows: list[Row]) -> str:
    """The rows as they stand on the page."""
    return "\n".join(["| option | value | |", "|---|---|---|", *(row.line for row in rows)])


def names(group: str) -> set[str]:
    return {name for row in TABLES[group] for name in row.option.split(", ")}


def make(folder: Path, **changes: Any) -> tuple[EmulatorModule, TrajectoryDataModule]:
    torch.manual_seed(0)
    data = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=2)
    options = {"cells": 8, "frames": 2, "unroll": 2, "processor": TINY}
    return EmulatorModule(data.scene, **(options | changes)), data


def trainer_of(root: Path, **options: Any) -> lightning.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 1}
    steps = {"max_steps": 2, "val_check_interval": 2, "check_val_every_n_epoch": None}
    return lightning.Trainer(**({"accelerator": "cpu", "default_root_dir": root} | quiet | steps | options))


def marked(group: str, row: Row) -> Any:
    return pytest.param(row, id=f"{group}: {row}", marks=[pytest.mark.slow] if row.slow else [])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("row", [marked(group, row) for group, row in ROWS if row.verdict == "works"])
def test_works(row, make_dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = make_dataset()
    model, data = make(folder)
    start = [values.clone() for values in model.parameters()]
    trainer = trainer_of(tmp_path, **row.options(tmp_path))
    trainer.fit(model, data)
    steps = trainer.global_step
    assert steps > 0
    assert any(not torch.equal(one, other) for one, other in zip(start, model.parameters(), strict=True))
    if not row.resume:
        return
    trainer.save_checkpoint(tmp_path / "first.ckpt")
    trainer.test(model, data, verbose=False)
    longer = trainer_of(tmp_path, **(row.options(tmp_path) | {"max_steps": steps + 1, "max_epochs": -1}))
    longer.fit(*make(folder), ckpt_path=tmp_path / "first.ckpt", weights_only=True)
    assert longer.global_step == steps + 1


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("row", [marked(group, row) for group, row in ROWS if row.verdict == "refused"])
def test_is_refused_before_the_first_step(row, make_dataset, tmp_path):
    model, data = make(make_dataset())
    start = [values.clone() for values in model.parameters()]
    with pytest.raises(Exception, match=row.error) as caught:  # Lightning's own have any type
        trainer_of(tmp_path, **row.options(tmp_path)).fit(model, data)
    assert len(str(caught.value).splitlines()) == 1
    assert all(torch.equal(one, other) for one, other in zip(start, model.parameters(), strict=True))


def test_every_option_of_lightning_has_a_row():
    assert names("Arguments of the Trainer") == set(inspect.signature(lightning.Trainer.__init__).parameters) - {"self"}
    assert names("Precision") >= set(get_args(_PRECISION_INPUT_STR))
    assert names("Callbacks") == set(callbacks.__all__)
    assert names("Loggers") == set(loggers.__all__) - {"Logger"} | {"False"}
    assert names("Profilers") == set(profilers.__all__) - {"Profiler"}
    families = {"ddp", "deepspeed"}
    for name in StrategyRegistry.available_strategies():
        assert name in names("Strategies") or name.split("_")[0] in families, name


@pytest.mark.parametrize("group", TABLES)
def test_the_page_has_the_table(group):
    page = (ROOT / "docs" / "lightning.md").read_text("utf-8")
    assert f"## {group}\n\n{table(TABLES[group])}\n" in page, table(TABLES[group])


# Double precision


class Losses(lightning.Callback):
    """Keeps the losses, and the type of positions."""

    def __init__(self):
        self.seen, self.types = [], set()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.seen.append(outputs["loss"].item())
        self.types.add(batch.frames.dtype)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"optimizer": SOAP},
        {"transfer": Quadratic()},
        {"transfer": Nearest()},
        {"processor": ConvNeXt(width=8, depth=1)},
        {"processor": Axial(width=8, layers=1, heads=1)},
        {"processor": FNO(width=8, modes=2, layers=1)},
        {"processor": TFNO(width=8, modes=2, layers=1)},
    ],
    ids=lambda changes: str(*changes.values()).partition("(")[0],
)
def test_a_training_in_double_precision_is_as_in_single(changes, make_dataset, tmp_path):
    folder, records, errors = make_dataset(fields=("temperature",)), [], []
    for name in ("32-true", "64-true"):
        records.append(Losses())
        trainer = trainer_of(tmp_path, max_steps=3, precision=name, callbacks=[records[-1]])
        model, data = make(folder, position_noise=0.0, mirror=(), **changes)
        trainer.fit(model, data)
        errors.append(trainer.callback_metrics["valid/overall"].item())
    assert records[1].types == {torch.float64}
    assert all(values.dtype in (torch.float64, torch.complex128) for values in model.parameters())
    assert records[1].seen == pytest.approx(records[0].seen, rel=2e-4)
    assert errors[1] == pytest.approx(errors[0], rel=1e-3)


def test_a_training_in_double_precision_resumes_to_the_bit(make_dataset, tmp_path):
    folder = make_dataset()
    whole, half, resumed = make(folder), make(folder), make(folder)
    trainer_of(tmp_path, max_steps=4, precision="64-true").fit(*whole)
    trainer = trainer_of(tmp_path, max_steps=2, precision="64-true")
    trainer.fit(*half)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    rest = trainer_of(tmp_path, max_steps=4, precision="64-true")
    rest.fit(*resumed, ckpt_path=tmp_path / "half.ckpt", weights_only=True)
    for name, values in whole[0].state_dict().items():
        assert torch.equal(values, resumed[0].state_dict()[name]), name
    loaded = load_module(tmp_path / "half.ckpt").state_dict()  # in single precision
    for name, values in half[0].state_dict().items():
        torch.testing.assert_close(loaded[name], values.to(loaded[name].dtype))


def test_gradients_of_the_loss_in_double_precision_are_finite_differences(make_dataset):
    model, data = make(
        make_dataset(statics=2), processor=UNet(width=2, depth=1, perceptron=(2,)), gradient_discount=1.0
    )
    data.setup("fit")
    window: Window = next(iter(data.train_dataloader())).double()
    model.emulator.output_scale.fill_(0.05)  # so that particles move
    model.double().log = lambda *_, **__: None
    weights = dict(model.named_parameters())
    chosen = {name: values for name, values in list(weights.items())[-4:] if values.numel() < 40}
    assert chosen

    def loss(*values: torch.Tensor) -> torch.Tensor:
        module = _Loss(model, window)
        return torch.func.functional_call(module, {f"model.{n}": v for n, v in zip(chosen, values, strict=True)}, ())

    assert torch.autograd.gradcheck(loss, tuple(chosen.values()), eps=1e-7, atol=1e-7, rtol=1e-5)


class _Loss(torch.nn.Module):
    def __init__(self, model: EmulatorModule, window: Window) -> None:
        super().__init__()
        self.model, self.window = model, window

    def forward(self) -> torch.Tensor:
        return self.model.training_step(self.window, 0)


# Finders, a second fit, compiled networks


def test_the_learning_rate_finder_sets_the_rate_of_the_training(make_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("lightning.pytorch.tuner.lr_finder._LRFinder.suggestion", lambda *_, **__: 0.0123)
    folder = make_dataset()
    for tuned in (True, False):
        model, data = make(folder, optimizer=functools.partial(torch.optim.Adam, lr=1e-3))
        assert model.lr == 1e-3
        finder = [] if tuned else [callbacks.LearningRateFinder(num_training_steps=4)]
        trainer = trainer_of(tmp_path, max_steps=3, callbacks=finder)
        if tuned:
            Tuner(trainer).lr_find(model, datamodule=data, num_training=4)
        trainer.fit(model, data)
        assert trainer.global_step == 3
        assert trainer.optimizers[0].param_groups[0]["initial_lr"] == model.lr == 0.0123
        assert trainer.lr_scheduler_configs[0].scheduler.base_lrs == [0.0123]


@pytest.mark.parametrize("mode", ["power", "binsearch"])
def test_the_batch_size_finder_sets_that_of_the_data_and_a_resumed_training_goes_on(mode, make_dataset, tmp_path):
    folder, sizes = make_dataset(), []
    model, data = make(folder)
    trainer = trainer_of(tmp_path, max_steps=3)
    found = Tuner(trainer).scale_batch_size(model, datamodule=data, mode=mode, max_val=8, steps_per_trial=1, margin=0.0)
    model.on_train_batch_end = lambda outputs, batch, index: sizes.append(len(batch.frames))
    trainer.fit(model, data)
    assert sizes == [found] * 3 == [data.batch_size] * 3
    trainer.save_checkpoint(tmp_path / "found.ckpt")
    stored = torch.load(tmp_path / "found.ckpt", weights_only=True)["TrajectoryDataModule"]
    assert (stored["batch_size"], stored["start"]["batch"]) == (found, 0)


@pytest.mark.parametrize("finder", [callbacks.LearningRateFinder, callbacks.BatchSizeFinder, callbacks.SpikeDetection])
def test_what_cannot_resume_says_so(finder, make_dataset, tmp_path):
    folder = make_dataset()
    trainer = trainer_of(tmp_path)
    trainer.fit(*make(folder))
    trainer.save_checkpoint(tmp_path / "first.ckpt")
    with pytest.raises(ConfigError, match=f"{finder.__name__} cannot go on from a checkpoint"):
        trainer_of(tmp_path, max_steps=4, callbacks=[finder()]).fit(
            *make(folder), ckpt_path=tmp_path / "first.ckpt", weights_only=True
        )


def test_a_trainer_is_used_for_one_training(make_dataset, tmp_path):
    folder = make_dataset()
    trainer = trainer_of(tmp_path)
    trainer.fit(*make(folder))
    with pytest.raises(ConfigError, match=r"has taken 2 steps already.*new Trainer"):
        trainer.fit(*make(folder))


def test_batches_without_a_datamodule_train(make_dataset, tmp_path):
    model, data = make(make_dataset())
    data.setup("fit")
    trainer = trainer_of(tmp_path)
    trainer.fit(model, data.train_dataloader(), data.val_dataloader())
    assert trainer.global_step == 2
    assert model.emulator.calibrated


def test_overfit_batches_are_the_same_in_each_epoch(make_dataset, tmp_path):
    model, data = make(make_dataset())
    seen = []
    model.on_train_batch_end = lambda outputs, batch, index: seen.append(batch.frames.double().sum().item())
    trainer_of(tmp_path, max_steps=6, overfit_batches=2).fit(model, data)
    assert seen == seen[:2] * 3
    assert seen[0] != seen[1]


def test_a_network_compiled_by_hand_saves_what_a_plain_one_loads(make_dataset, tmp_path):
    folder = make_dataset()
    torch.compiler.reset()
    model, data = make(folder)
    model.emulator.processor = torch.compile(model.emulator.processor, backend="eager")
    trainer = trainer_of(tmp_path)
    trainer.fit(model, data)
    trainer.save_checkpoint(tmp_path / "compiled.ckpt")
    loaded = load_module(tmp_path / "compiled.ckpt")
    assert list(loaded.state_dict()) == list(make(folder)[0].state_dict())
    assert all(torch.equal(values, loaded.state_dict()[name]) for name, values in model.state_dict().items())
    model.load_state_dict(loaded.state_dict())


def test_a_module_compiled_as_a_whole_is_refused(make_dataset, tmp_path):
    model, data = make(make_dataset())
    with pytest.raises(ConfigError, match="give it compile=True"):
        trainer_of(tmp_path).fit(torch.compile(model, backend="eager"), data)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--trainer.precision", "16-true"], "bf16-mixed"),
        (["--trainer.precision", "transformer-engine"], "transformer_engine"),
        (["--trainer.strategy", "nonsense"], "invalid strategy name"),
        (["--trainer.strategy", "fsdp"], "requires a GPU"),
        (["--trainer.strategy", "ddp_spawn", "--trainer.devices", "2"], "is for notebooks: give ddp"),
        (["--trainer.accumulate_grad_batches", "0"], "must be at least 1"),
        (["--trainer.barebones", "true"], "train from Python"),
        (["--trainer.logger", "lightning.pytorch.loggers.MLFlowLogger"], "mlflow"),
    ],
    ids=lambda words: words[1] if isinstance(words, list) else "",
)
def test_the_command_line_refuses_in_one_line(words, message, make_dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    common = ["fit", "--config", "waterdrop.yaml", "--data.path", str(make_dataset()), "--trainer.accelerator", "cpu"]
    assert main([*common, *words]) == 1
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert message in said[0]
