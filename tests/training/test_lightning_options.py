"""Options of Lightning: each trains, or is refused in a line before the first step; `docs/lightning.md` lists them."""

import datetime
import functools
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
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
from nmpm.training.module import load_module
from nmpm.transfer import Nearest, Quadratic
from tests.trainings import QUIET, TINY, Record

PAGE = Path(__file__).parents[2] / "docs" / "lightning.md"
EPOCHS = {"max_epochs": 2, "max_steps": -1, "limit_train_batches": 2, "val_check_interval": None,
          "check_val_every_n_epoch": 1}  # fmt: skip
BARE = dict.fromkeys(
    ["num_sanity_val_steps", "logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"]
)
Options = dict[str, Any] | Callable[[Path], dict[str, Any]]


def use(name: str, logged: bool = False, options: dict[str, Any] | None = None, **arguments: Any) -> Options:
    """The Trainer's options with a callback of Lightning's; FOLDER among its arguments is a folder."""

    def make(folder: Path) -> dict[str, Any]:
        given = {key: folder if value == "FOLDER" else value for key, value in arguments.items()}
        logger = {"logger": loggers.CSVLogger(folder)} if logged else {}
        return {"callbacks": [getattr(callbacks, name)(**given)]} | logger | (options or {})

    return make


RESUMED: dict[str, Options] = {  # these go on from a checkpoint, too
    "max_epochs: with `limit_train_batches`": EPOCHS,
    "max_steps": {"max_steps": 3},
    "accumulate_grad_batches": {"accumulate_grad_batches": 2},
    "plugins: checkpoint I/O, cluster environments, precision": lambda _: {
        "plugins": [AsyncCheckpointIO(), LightningEnvironment()]
    },
    "32-true": {"precision": "32-true"},
    "64-true": {"precision": "64-true"},
    "bf16-mixed": {"precision": "bf16-mixed"},
    "EarlyStopping: valid/overall, train/loss": use("EarlyStopping", monitor="valid/overall"),
    "ModelCheckpoint": use("ModelCheckpoint", monitor="valid/overall", save_last=True, dirpath="FOLDER"),
    "EMAWeightAveraging": use("EMAWeightAveraging", use_buffers=False),
    "WeightAveraging: use_buffers=False": use("WeightAveraging", use_buffers=False),
    "Timer": use("Timer", duration="00:00:01:00"),
}
WORKS: dict[str, Options] = RESUMED | {
    "accelerator: cpu, auto": {"accelerator": "auto"},
    "strategy": {"strategy": "auto"},
    "devices": {"devices": 1},
    "precision": {"precision": "32-true"},
    "logger": {"logger": True},
    "callbacks": {"callbacks": []},
    "fast_dev_run": {"fast_dev_run": 2},
    "min_epochs: with `limit_train_batches`": EPOCHS | {"min_epochs": 1},
    "min_steps: with `limit_train_batches`": EPOCHS | {"min_steps": 2},
    "max_time": {"max_time": datetime.timedelta(seconds=0.5), "max_steps": -1},
    "limit_train_batches: a number": {"limit_train_batches": 2},
    "limit_val_batches": {"limit_val_batches": 1},
    "limit_test_batches": {"limit_test_batches": 1},
    "limit_predict_batches": {"limit_predict_batches": 1},
    "overfit_batches: a number": {"overfit_batches": 2},
    "val_check_interval: a number of steps, a time": {"val_check_interval": "00:00:00:01"},
    "check_val_every_n_epoch": EPOCHS,
    "num_sanity_val_steps": {"num_sanity_val_steps": -1},
    "log_every_n_steps": {"log_every_n_steps": 1},
    "enable_checkpointing": {"enable_checkpointing": False},
    "enable_progress_bar": {"enable_progress_bar": True},
    "enable_model_summary": {"enable_model_summary": True},
    "gradient_clip_val": {"gradient_clip_val": 1.0},
    "gradient_clip_algorithm": {"gradient_clip_val": 1.0, "gradient_clip_algorithm": "value"},
    "deterministic": {"deterministic": "warn"},
    "benchmark": {"benchmark": True},
    "inference_mode": {"inference_mode": False},
    "use_distributed_sampler": {"use_distributed_sampler": False},
    "profiler": {"profiler": "simple"},
    "detect_anomaly": {"detect_anomaly": True},
    "barebones": BARE | {"barebones": True},
    "sync_batchnorm": {"sync_batchnorm": True},
    "reload_dataloaders_every_n_epochs": EPOCHS | {"reload_dataloaders_every_n_epochs": 1},
    "default_root_dir": lambda folder: {"default_root_dir": folder / "elsewhere"},
    "enable_autolog_hparams": {"enable_autolog_hparams": False},
    "16-mixed": {"precision": "16-mixed"},
    "DoublePrecision: plugin": lambda _: {"plugins": precision.DoublePrecision()},
    "MixedPrecision: plugin": lambda _: {"plugins": precision.MixedPrecision("bf16-mixed", "cpu")},
    "auto, single_device": {"strategy": "single_device"},
    "CSVLogger": lambda folder: {"logger": [loggers.CSVLogger(folder), loggers.TensorBoardLogger(folder)]},
    "TensorBoardLogger": lambda folder: {"logger": loggers.TensorBoardLogger(folder)},
    "False": {"logger": False},
    "SimpleProfiler": lambda _: {"profiler": profilers.SimpleProfiler()},
    "AdvancedProfiler": lambda _: {"profiler": profilers.AdvancedProfiler()},
    "PyTorchProfiler": lambda folder: {"profiler": profilers.PyTorchProfiler(folder)},
    "PassThroughProfiler": lambda _: {"profiler": profilers.PassThroughProfiler()},
    "OnExceptionCheckpoint": use("OnExceptionCheckpoint", dirpath="FOLDER"),
    "LearningRateMonitor": use("LearningRateMonitor", logged=True),
    "LearningRateFinder": use("LearningRateFinder", num_training_steps=4),
    "BatchSizeFinder": use("BatchSizeFinder", max_val=8, steps_per_trial=1),
    "GradientAccumulationScheduler: from epoch 0": use("GradientAccumulationScheduler", scheduling={0: 2}),
    "StochasticWeightAveraging: with epochs": use(
        "StochasticWeightAveraging", options=EPOCHS, swa_lrs=1e-3, swa_epoch_start=1
    ),
    "LambdaCallback": use("LambdaCallback", on_train_start=lambda *_: None),
    "DeviceStatsMonitor": use("DeviceStatsMonitor", logged=True),
    "ThroughputMonitor": use("ThroughputMonitor", logged=True, batch_size_fn=lambda window: len(window.frames)),
    "SpikeDetection": use("SpikeDetection"),
    "ModelSummary": use("ModelSummary", options={"enable_model_summary": True}),
    "RichModelSummary": use("RichModelSummary", options={"enable_model_summary": True}),
    "RichProgressBar": use("RichProgressBar", options={"enable_progress_bar": True}),
    "TQDMProgressBar": use("TQDMProgressBar", options={"enable_progress_bar": True}),
}
REFUSED: dict[str, tuple[Options, str]] = {
    "accelerator: tpu": ({"accelerator": "tpu"}, "torch_xla"),
    "max_epochs: alone": ({"max_epochs": 2, "max_steps": -1}, "has no end"),
    "min_epochs: alone": ({"min_epochs": 1}, "min_epochs=1 needs epochs that end"),
    "min_steps: alone": ({"min_steps": 2}, "min_steps=2 needs epochs that end"),
    "limit_train_batches: a share": ({"limit_train_batches": 0.5}, "1.0"),
    "overfit_batches: a share": ({"overfit_batches": 0.5}, "0.5 of 1 batches is none"),
    "val_check_interval: a share": ({"val_check_interval": 0.5}, "should be an integer"),
    "bf16-true": ({"precision": "bf16-true"}, "bf16-true.*bf16-mixed.*32-true"),
    "16-true": ({"precision": "16-true"}, "16-true.*bf16-mixed.*32-true"),
    "transformer-engine": ({"precision": "transformer-engine"}, "transformer_engine"),
    "transformer-engine-float16": ({"precision": "transformer-engine-float16"}, "transformer_engine"),
    "HalfPrecision: plugin": (lambda _: {"plugins": precision.HalfPrecision("16-true")}, "positions in float16"),
    "BitsandbytesPrecision: plugin": (
        lambda _: {"plugins": precision.BitsandbytesPrecision("nf4")}, "bitsandbytes"
    ),
    "fsdp, fsdp_cpu_offload: without a GPU": ({"strategy": "fsdp"}, "requires a GPU"),
    "deepspeed: and its stages": ({"strategy": "deepspeed"}, "DeepSpeed"),
    "ModelParallelStrategy": (
        lambda _: {"strategy": ModelParallelStrategy(), "devices": 1}, "ModelParallelStrategy"
    ),
    "xla, single_xla, single_tpu, xla_debug": ({"strategy": "xla"}, "torch_xla"),
    "XLAProfiler": (lambda _: {"profiler": profilers.XLAProfiler()}, "torch_xla"),
    "EarlyStopping: another `monitor`": (use("EarlyStopping", monitor="val_loss"), "val_loss, which is never logged"),
    "ModelCheckpoint: another `monitor`": (
        use("ModelCheckpoint", monitor="val_loss"), "val_loss, which is never logged"
    ),
    "GradientAccumulationScheduler: from later epochs": (
        use("GradientAccumulationScheduler", scheduling={0: 2, 4: 3}), "epoch 4 on needs epochs"
    ),
    "WeightAveraging: use_buffers=True": (use("WeightAveraging"), "use_buffers=False"),
    "StochasticWeightAveraging: without": (
        use("StochasticWeightAveraging", swa_lrs=1e-3), "StochasticWeightAveraging needs epochs"
    ),
    "ModelPruning": (use("ModelPruning", pruning_fn="l1_unstructured"), "ModelPruning.*fewer channels"),
    "BackboneFinetuning": (use("BackboneFinetuning"), "EmulatorModule.of"),
}  # fmt: skip
IN_EACH_RUN = ("ModelCheckpoint", "64-true", "ModelPruning", "EarlyStopping: another `monitor`")


def marked(name: str) -> Any:
    return pytest.param(name, marks=[] if name in IN_EACH_RUN else pytest.mark.slow)


def make(folder: Path, **changes: Any) -> tuple[EmulatorModule, TrajectoryDataModule]:
    torch.manual_seed(0)
    data = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=2)
    return EmulatorModule(data.scene, **({"cells": 8, "frames": 2, "unroll": 2, "processor": TINY} | changes)), data


def trainer_of(root: Path, **options: Any) -> lightning.Trainer:
    steps = {"max_steps": 2, "val_check_interval": 2, "check_val_every_n_epoch": None, "num_sanity_val_steps": 1}
    return lightning.Trainer(**{"accelerator": "cpu", "default_root_dir": root, **QUIET, **steps, **options})


def options_of(given: Options, folder: Path) -> dict[str, Any]:
    return given if isinstance(given, dict) else given(folder)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(map(marked, WORKS)))
def test_works(name, make_dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = make_dataset()
    model, data = make(folder)
    start = [values.clone() for values in model.parameters()]
    trainer = trainer_of(tmp_path, **options_of(WORKS[name], tmp_path))
    trainer.fit(model, data)
    steps = trainer.global_step
    assert steps > 0
    assert any(not torch.equal(one, other) for one, other in zip(start, model.parameters(), strict=True))
    if name not in RESUMED:
        return
    trainer.save_checkpoint(tmp_path / "first.ckpt")
    trainer.test(model, data, verbose=False)
    longer = trainer_of(tmp_path, **(options_of(WORKS[name], tmp_path) | {"max_steps": steps + 1, "max_epochs": -1}))
    longer.fit(*make(folder), ckpt_path=tmp_path / "first.ckpt", weights_only=True)
    assert longer.global_step == steps + 1


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(map(marked, REFUSED)))
def test_is_refused_before_the_first_step(name, make_dataset, tmp_path):
    options, error = REFUSED[name]
    model, data = make(make_dataset())
    start = [values.clone() for values in model.parameters()]
    with pytest.raises(Exception, match=error) as caught:  # Lightning's own have any type
        trainer_of(tmp_path, **options_of(options, tmp_path)).fit(model, data)
    assert len(str(caught.value).splitlines()) == 1
    assert all(torch.equal(one, other) for one, other in zip(start, model.parameters(), strict=True))


def test_the_page_lists_every_option_of_lightning_and_each_is_tried():
    rows = re.findall(r"^\| `(.+?)` \| *(.*?) *\| *(works|refused|not tested)", PAGE.read_text("utf-8"), re.MULTILINE)
    listed = {name for row, _, _ in rows for name in row.split(", ")}
    for verdict, cases in (("works", WORKS), ("refused", REFUSED)):
        named = [(name, value) for names, value, found in rows if found == verdict for name in names.split(", ")]
        tried = [
            (name, value) for case in cases for names, _, value in [case.partition(": ")] for name in names.split(", ")
        ]
        assert sorted(named) == sorted(tried)
    assert listed >= set(inspect.signature(lightning.Trainer.__init__).parameters) - {"self"}
    assert listed >= set(callbacks.__all__)
    assert listed >= {*loggers.__all__, *profilers.__all__} - {"Logger", "Profiler"}
    families = {"ddp", "deepspeed"}
    assert all(name in listed or name.split("_")[0] in families for name in StrategyRegistry.available_strategies())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        *(
            pytest.param(changes, marks=pytest.mark.slow)
            for changes in (
                {"optimizer": SOAP},
                {"transfer": Quadratic()},
                {"transfer": Nearest()},
                {"processor": ConvNeXt(width=8, depth=1)},
                {"processor": Axial(width=8, layers=1, heads=1)},
                {"processor": FNO(width=8, modes=2, layers=1)},
                {"processor": TFNO(width=8, modes=2, layers=1)},
            )
        ),
    ],
    ids=lambda changes: str(*changes.values()).partition("(")[0],
)
def test_a_training_in_double_precision_is_as_in_single_and_resumes_to_the_bit(changes, make_dataset, tmp_path):
    folder, records, errors = make_dataset(fields=("temperature",)), {}, {}
    for name in ("32-true", "64-true"):
        records[name] = Record()
        trainer = trainer_of(tmp_path, max_steps=3, precision=name, callbacks=[records[name]])
        whole, data = make(folder, **changes)
        trainer.fit(whole, data)
        errors[name] = trainer.callback_metrics["valid/overall"].item()
    assert all(values.dtype in (torch.float64, torch.complex128) for values in whole.parameters())
    assert records["64-true"].losses == pytest.approx(records["32-true"].losses, rel=2e-4)
    assert errors["64-true"] == pytest.approx(errors["32-true"], rel=1e-3)
    half, resumed = make(folder, **changes), make(folder, **changes)
    trainer = trainer_of(tmp_path, max_steps=2, precision="64-true")
    trainer.fit(*half)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    rest = trainer_of(tmp_path, max_steps=3, precision="64-true")
    rest.fit(*resumed, ckpt_path=tmp_path / "half.ckpt", weights_only=True)
    for name, values in whole.state_dict().items():
        assert torch.equal(values, resumed[0].state_dict()[name]), name
    loaded = load_module(tmp_path / "half.ckpt").state_dict()  # in single precision
    for name, values in half[0].state_dict().items():
        torch.testing.assert_close(loaded[name], values.to(loaded[name].dtype))


class _Loss(torch.nn.Module):
    def __init__(self, model: EmulatorModule, window: Window) -> None:
        super().__init__()
        self.model, self.window = model, window

    def forward(self) -> torch.Tensor:
        return self.model.training_step(self.window, 0)


def test_gradients_of_the_loss_in_double_precision_are_finite_differences(make_dataset):
    small = UNet(width=2, depth=1, perceptron=(2,))
    model, data = make(make_dataset(statics=2), processor=small, gradient_discount=1.0)
    data.setup("fit")
    window: Window = next(iter(data.train_dataloader())).double()
    model.emulator.output_scale.fill_(0.05)  # so that particles move
    model.double().log = lambda *_, **__: None
    weights = {name: values for name, values in list(model.named_parameters())[-4:] if values.numel() < 40}
    assert weights

    def loss(*values: torch.Tensor) -> torch.Tensor:
        named = {f"model.{name}": value for name, value in zip(weights, values, strict=True)}
        return torch.func.functional_call(_Loss(model, window), named, ())

    assert torch.autograd.gradcheck(loss, tuple(weights.values()), eps=1e-7, atol=1e-7, rtol=1e-5)


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


def test_the_batch_size_finder_sets_that_of_the_data(make_dataset, tmp_path):
    (model, data), sizes = make(make_dataset()), []
    trainer = trainer_of(tmp_path, max_steps=3)
    size = Tuner(trainer).scale_batch_size(model, datamodule=data, max_val=8, steps_per_trial=1, margin=0.0)
    model.on_train_batch_end = lambda outputs, batch, index: sizes.append(len(batch.frames))
    trainer.fit(model, data)
    assert sizes == [size] * 3 == [data.batch_size] * 3
    trainer.save_checkpoint(tmp_path / "found.ckpt")
    stored = torch.load(tmp_path / "found.ckpt", weights_only=True)["TrajectoryDataModule"]
    assert (stored["batch_size"], stored["start"]["batch"]) == (size, 0)


def test_finders_do_not_resume_and_a_trainer_is_used_once(make_dataset, tmp_path):
    folder, trainer = make_dataset(), trainer_of(tmp_path)
    trainer.fit(*make(folder))
    with pytest.raises(ConfigError, match=r"has taken 2 steps already.*new Trainer"):
        trainer.fit(*make(folder))
    trainer.save_checkpoint(tmp_path / "first.ckpt")
    for finder in (callbacks.LearningRateFinder, callbacks.BatchSizeFinder, callbacks.SpikeDetection):
        with pytest.raises(ConfigError, match=f"{finder.__name__} cannot go on from a checkpoint"):
            trainer_of(tmp_path, max_steps=4, callbacks=[finder()]).fit(
                *make(folder), ckpt_path=tmp_path / "first.ckpt", weights_only=True
            )


def test_batches_without_a_datamodule_train(make_dataset, tmp_path):
    model, data = make(make_dataset())
    data.setup("fit")
    trainer = trainer_of(tmp_path)
    trainer.fit(model, data.train_dataloader(), data.val_dataloader())
    assert trainer.global_step == 2
    assert model.emulator.calibrated


def test_a_network_compiled_by_hand_saves_what_a_plain_one_loads_and_a_compiled_module_is_refused(
    make_dataset, tmp_path
):
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
    with pytest.raises(ConfigError, match="give it compile=True"):
        trainer_of(tmp_path).fit(torch.compile(model, backend="eager"), data)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--trainer.precision", "16-true"], "bf16-mixed"),
        (["--trainer.strategy", "nonsense"], "invalid strategy name"),
        (["--trainer.strategy", "ddp_spawn", "--trainer.devices", "2"], "is for notebooks: give ddp"),
        (["--trainer.barebones", "true"], "train from Python"),
        (["--trainer.logger", "lightning.pytorch.loggers.MLFlowLogger"], "mlflow"),
    ],
    ids=lambda words: words[1] if isinstance(words, list) else "",
)
def test_the_command_line_refuses_in_one_line(words, message, make_dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    common = ["fit", "--config", "waterdrop.yaml", "--data.path", str(make_dataset()), "--trainer.accelerator", "cpu"]
    assert main([*common, *words]) == 1
    contradictions = ("Warning: these data", "  ")  # of the made-up data
    said = [line for line in capsys.readouterr().err.strip().splitlines() if not line.startswith(contradictions)]
    assert len(said) == 1
    assert message in said[0]
