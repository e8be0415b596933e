import functools
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import EMAWeightAveraging, ModelCheckpoint, OnExceptionCheckpoint
from torch.utils._python_dispatch import TorchDispatchMode

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.decoders import Absolute
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError, NmpmError
from nmpm.metrics import MSE
from nmpm.optimizers import SOAP
from nmpm.processors import UNet
from nmpm.training import EmulatorModule
from nmpm.training.callbacks.report import ReportWriter
from nmpm.training.checkpoints import load_module
from nmpm.training.schedules import Schedule
from nmpm.transfer import Nearest, without_kernels

TINY = UNet(width=4, depth=1, perceptron=(4,))


def module_of(data: TrajectoryDataModule, **changes) -> EmulatorModule:
    torch.manual_seed(0)
    options = {"cells": 8, "frames": 2, "unroll": 2, "processor": TINY, "position_noise": 1e-4}
    options |= {"grid_noise": 0.01, "metrics": [MSE((1, 4))]}
    return EmulatorModule(data.scene, **(options | changes))


def data_of(folder: Path) -> TrajectoryDataModule:
    return TrajectoryDataModule(path=str(folder), horizon=4, batch_size=2)


def trainer_of(root: Path, steps: int, **options) -> lightning.Trainer:
    defaults = {
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "val_check_interval": 2,
        "check_val_every_n_epoch": None,
        "num_sanity_val_steps": 0,
        "gradient_clip_val": 1.0,
    }
    averaging = EMAWeightAveraging(decay=0.5, use_buffers=False)
    further = options.pop("callbacks", [])
    last = ModelCheckpoint(root, filename="last", every_n_train_steps=2, enable_version_counter=False)
    return lightning.Trainer(
        accelerator="cpu",
        max_steps=steps,
        default_root_dir=root,
        callbacks=[averaging, last, *further],
        **(defaults | options),
    )


class Losses(lightning.Callback):
    """Keeps the loss of every step."""

    def __init__(self):
        self.seen = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.seen.append(outputs["loss"].item())


class Seeds(lightning.Callback):
    """Keeps the seed of every finished step, and fails before one of them."""

    def __init__(self, fail_at: int | None = None):
        self.seen, self.fail_at = [], fail_at

    def on_before_zero_grad(self, trainer, pl_module, optimizer):
        if len(self.seen) == self.fail_at:
            raise RuntimeError("interrupted")

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.seen.append(torch.initial_seed())


def test_training_lowers_the_loss_and_reports_rollouts_beside_the_trivial_predictors(make_dataset, tmp_path):
    data = data_of(make_dataset())
    fast = functools.partial(torch.optim.Adam, lr=1e-2)
    squares = {"error_power": 1.0, "density_weight": 0.0}
    model = module_of(data, schedule=Schedule(warmup=2), position_noise=0.0, grid_noise=0.0, optimizer=fast, **squares)
    trainer, losses = trainer_of(tmp_path, 80, val_check_interval=80), Losses()
    trainer.callbacks.append(losses)
    trainer.fit(model, data)
    assert sum(losses.seen[-5:]) < 0.7 * sum(losses.seen[:5])
    figures = trainer.callback_metrics
    for kind in ("", "still/", "free_fall/"):
        for name in ("mse", "mse@1", "mse@4"):
            assert figures[f"valid/{kind}{name}"].isfinite()
    longer = torch.stack([figures[f"valid/{name}"] for name in ("mse@4", "mse")])  # than the 4 frames trained for
    torch.testing.assert_close(figures["valid/overall"], longer.prod().sqrt())


@pytest.mark.parametrize("optimizer", [functools.partial(torch.optim.Adam, lr=1e-3), SOAP])
def test_a_resumed_training_ends_with_the_same_weights(make_dataset, tmp_path, optimizer):
    folder = make_dataset()

    def made() -> tuple[EmulatorModule, TrajectoryDataModule]:
        data = data_of(folder)
        return module_of(data, optimizer=optimizer), data

    whole, resumed = made(), made()
    trainer_of(tmp_path / "whole", 16).fit(*whole)
    trainer_of(tmp_path / "parts", 6).fit(*made())
    trainer_of(tmp_path / "parts", 16).fit(*resumed, ckpt_path=tmp_path / "parts" / "last.ckpt", weights_only=True)
    for name, value in whole[0].state_dict().items():
        assert torch.equal(value, resumed[0].state_dict()[name]), name


def test_a_training_interrupted_within_a_batch_resumes_with_its_random_numbers(make_dataset, tmp_path):
    data = data_of(make_dataset())
    whole, broken, resumed = Seeds(), Seeds(fail_at=4), Seeds()
    trainer_of(tmp_path / "whole", 7, callbacks=[whole]).fit(module_of(data), data)
    saving = OnExceptionCheckpoint(tmp_path, "broken")
    with pytest.raises(RuntimeError, match="interrupted"):
        trainer_of(tmp_path / "parts", 7, callbacks=[broken, saving]).fit(module_of(data), data)
    trainer_of(tmp_path / "rest", 7, callbacks=[resumed]).fit(
        module_of(data), data_of(tmp_path / "dataset"), ckpt_path=tmp_path / "broken.ckpt", weights_only=True
    )
    assert len(set(whole.seen)) == 7
    assert broken.seen + resumed.seen == whole.seen


def test_a_checkpoint_stands_alone(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model = module_of(data, transfer=Nearest(), decoder=Absolute())
    trainer_of(tmp_path, 2).fit(model, data)
    loaded = EmulatorModule.load_from_checkpoint(tmp_path / "last.ckpt", weights_only=True, map_location="cpu")
    assert loaded.emulator.scene == data.scene
    assert (loaded.emulator.recipe.processor, loaded.emulator.transfer, loaded.emulator.decoder) == (
        TINY,
        Nearest(),
        Absolute(),
    )
    assert loaded.emulator.calibrated
    for name, value in model.emulator.state_dict().items():
        assert torch.equal(value, loaded.emulator.state_dict()[name]), name


@pytest.mark.filterwarnings("error:The emulator is in training mode")
def test_validations_and_tests_are_rollouts_in_evaluation_mode(make_dataset, tmp_path):
    data = data_of(make_dataset())
    module = module_of(data, constraints=Constraints(energy=True))
    trainer = trainer_of(tmp_path, 2)
    trainer.fit(module, data)
    trainer.test(module, data)
    with pytest.warns(UserWarning, match="training mode"):
        rollout(EmulatorModule.of(module.emulator).emulator, next(iter(data.test_dataloader())).initial, 2)


def test_a_pretrained_emulator_keeps_its_statistics(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model = module_of(data)
    model.emulator.input_std.fill_(3.0)
    model.emulator.calibrated.fill_(True)
    trainer_of(tmp_path, 1, val_check_interval=1).fit(model, data)
    assert (model.emulator.input_std == 3.0).all()


def test_fine_tuning_starts_from_the_same_predictions(make_dataset, tmp_path):
    data = data_of(make_dataset())
    pretrained = module_of(data, transfer=Nearest()).emulator
    pretrained.output_scale.fill_(0.5)
    pretrained.calibrated.fill_(True)
    tuned = EmulatorModule.of(pretrained, unroll=2)
    window = next(iter(data.test_dataloader()))
    before = rollout(pretrained.eval(), window.initial, 6)
    assert torch.equal(rollout(tuned.emulator.eval(), window.initial, 6), before)
    trainer_of(tmp_path, 2).fit(tuned, data)
    assert not torch.equal(rollout(tuned.emulator.eval(), window.initial, 6), before)
    assert torch.equal(rollout(pretrained, window.initial, 6), before)


def test_data_of_another_scene_are_refused(make_dataset, tmp_path):
    data = data_of(make_dataset())
    for stage in ("fit", "test"):
        model = EmulatorModule(replace(data.scene, obstacles=not data.scene.obstacles), cells=8, processor=TINY)
        with pytest.raises(ConfigError, match=r"obstacles = (True|False), not (True|False).*over\(data.scene\)"):
            getattr(trainer_of(tmp_path, 1), stage)(model, data)
    renamed = replace(data.scene, materials=tuple(f"my {name}" for name in data.scene.materials))
    assert data.scene.differences(renamed) == ()
    assert renamed.differences(replace(renamed, dt=1.0, particle_volume=1.0)) == ("dt", "particle_volume")


def test_windows_shorter_than_a_training_step_are_refused_and_longer_ones_cut(make_dataset, tmp_path):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match=r"data\.horizon = 4 .* 6 frames .*frames = 2 .*unroll = 3"):
        trainer_of(tmp_path, 1).fit(module_of(data, unroll=3), data)
    trainer_of(tmp_path, 1, limit_test_batches=1).test(module_of(data, unroll=3), data)  # of whole trajectories
    trainer_of(tmp_path, 1).fit(module_of(data, unroll=1), data)


def test_bundles_grow_over_the_share_of_the_training_asked_for(make_dataset, tmp_path):
    data = data_of(make_dataset())
    module = module_of(data, unroll=4, unroll_growth=0.5)
    assert [module.bundles(share / 8) for share in range(9)] == [1, 1, 2, 3, 4, 4, 4, 4, 4]
    assert module_of(data, unroll=4).bundles(0.0) == 4
    data = TrajectoryDataModule(path=str(tmp_path / "dataset"), horizon=8, batch_size=2)
    unrolled = []
    module.bundles = lambda progress: unrolled.append(progress) or 1
    trainer_of(tmp_path, 4).fit(module, data)
    assert unrolled == [0.0, 0.25, 0.5, 0.75]
    with pytest.raises(ConfigError, match=r"unroll_growth = 2.*share"):
        module_of(data, unroll_growth=2.0)


def test_bf16_trains(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model = module_of(data)
    trainer = trainer_of(tmp_path, 2, precision="bf16-mixed")
    trainer.fit(model, data)
    assert trainer.callback_metrics["train/loss"].isfinite()
    assert all(p.dtype == torch.float32 for p in model.parameters())


def test_errors_of_a_bf16_training_are_those_of_the_loaded_model(make_dataset, tmp_path):
    data = data_of(make_dataset())
    trainer = trainer_of(tmp_path, 2, precision="bf16-mixed", callbacks=[ReportWriter()])
    trainer.fit(module_of(data), data)
    trainer.save_checkpoint(tmp_path / "trained.ckpt")
    emulator = load_module(tmp_path / "trained.ckpt").emulator.eval()
    metric = MSE()
    for window in data.test_dataloader():
        metric.update(window, rollout(emulator, window.initial, window.target.shape[1]))
    expected = sorted(row["mse"] for row in metric.per_trajectory())
    for precision in ("bf16-mixed", "32-true"):
        tester = trainer_of(tmp_path, 2, precision=precision, callbacks=[ReportWriter()])
        tester.test(module_of(data), data, ckpt_path=tmp_path / "trained.ckpt", weights_only=True)
        report = json.loads((tmp_path / "report.json").read_text())
        found = sorted(row["mse"] for row in report["per_trajectory"]["model"])
        assert found == pytest.approx(expected, rel=1e-6)
        assert report["training"]["precision"] == "bf16-mixed"


@pytest.mark.parametrize(
    ("step", "factor"), [(0, 0.01), (50, 0.505), (100, 1.0), (999, 1.0), (50_500, 0.5), (1e5, 0.0)]
)
def test_schedule_is_the_papers(step, factor):
    assert Schedule(warmup=100, flat=900, start=0.01).factor(step, 1e5) == pytest.approx(
        factor, abs=2e-6 if step else 0
    )


def test_a_schedule_by_the_clock_ends_at_zero(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model = module_of(data, schedule=Schedule(warmup=0))
    trainer = trainer_of(tmp_path, 10**6, max_time="00:00:00:03", val_check_interval=10**6, limit_val_batches=0)
    trainer.fit(model, data)
    assert trainer.global_step < 10**6
    assert trainer.optimizers[0].param_groups[0]["lr"] < 1e-5


def test_a_trajectory_shorter_than_a_window_is_named(make_dataset, tmp_path):
    data = data_of(make_dataset(train=((12, 5), (5, 5))))
    with pytest.raises(NmpmError, match=r"train\.h5.*00001.*5 frames.*needs 6"):
        trainer_of(tmp_path, 1, val_check_interval=1).fit(module_of(data), data)


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_training import data_of, module_of, trainer_of
data = data_of(Path({folder!r}))
root = Path({root!r})
last = root / "last.ckpt"
trainer_of(root, 30).fit(module_of(data), data, ckpt_path=last if last.exists() else None, weights_only=True)
"""


@pytest.mark.slow
def test_kill_9_in_mid_training_loses_nothing_but_time(make_dataset, tmp_path):
    folder = make_dataset()

    def script(root: Path) -> list[str]:
        text = SCRIPT.format(tests=str(Path(__file__).parent), folder=str(folder), root=str(root))
        return [sys.executable, "-c", text]

    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    killed = subprocess.Popen(script(tmp_path / "killed"), env=environment, stderr=subprocess.DEVNULL)
    while not (tmp_path / "killed" / "last.ckpt").exists():
        assert killed.poll() is None, "it ended before its first checkpoint"
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    for root in (tmp_path / "killed", tmp_path / "whole"):
        subprocess.run(script(root), env=environment, check=True, stderr=subprocess.DEVNULL)
    states = [torch.load(tmp_path / name / "last.ckpt", weights_only=True) for name in ("killed", "whole")]
    assert states[0]["global_step"] == states[1]["global_step"] == 30
    for name, value in states[1]["state_dict"].items():
        assert torch.equal(value, states[0]["state_dict"][name]), name


def test_recomputed_gradients_are_the_same_to_the_bit_for_less_memory(make_dataset):
    data = data_of(make_dataset())
    data.setup("fit")
    window = next(iter(data.train_dataloader()))

    def gradients(recompute: bool) -> tuple[list[torch.Tensor], int]:
        module = module_of(data, recompute=recompute)
        module.log = lambda *_, **__: None
        kept = 0

        def count(tensor: torch.Tensor) -> torch.Tensor:
            nonlocal kept
            kept += tensor.numel()
            return tensor

        torch.manual_seed(1)  # the same noise
        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            loss = module.training_step(window, 0)
        loss.backward()
        return [p.grad for p in module.parameters()], kept

    (plain, held), (recomputed, less) = gradients(False), gradients(True)
    assert less < held / 4
    for one, other in zip(plain, recomputed, strict=True):
        assert torch.equal(one, other)


class Questions(TorchDispatchMode):
    """Keeps what would make a GPU wait, or be waited for: values asked from it, numbers sent to it."""

    ASKING = ("_local_scalar_dense", "nonzero", "equal", "masked_select", "lift_fresh", "is_nonzero")

    def __init__(self):
        super().__init__()
        self.asked = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.overloadpacket.__name__ in self.ASKING:
            self.asked.append(str(func))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("statics", [0, 3])
def test_a_training_step_runs_on_the_device_alone(make_dataset, statics):
    data = data_of(make_dataset(statics=statics))
    data.setup("fit")
    window = next(iter(data.train_dataloader()))
    module = module_of(data)
    module.log = lambda *_, **__: None
    with without_kernels(), Questions() as questions:  # as on a device: the kernels are a CPU's
        module.training_step(window, 0).backward()
    assert questions.asked == []
    with Questions() as questions:
        assert bool(window.mask.any())
    assert questions.asked  # it does see such questions


@pytest.mark.parametrize("backend", ["eager", "broken"])
def test_a_compiled_network_trains_to_the_same_weights_and_a_broken_compiler_is_no_harm(
    make_dataset, tmp_path, backend, monkeypatch
):
    complaints = []

    def broken(*_):
        raise RuntimeError("no compiler here")

    def compile_network(network):
        if backend == "eager":
            plain(network, backend=backend)
        else:  # fails in the first call, as `compile` does, whatever torch remembers of other tests' compilations
            network._compiled_call_impl = broken

    # Not by caplog: other tests of the same process may have switched loggers off.
    monkeypatch.setattr("nmpm.emulator.model._LOG.warning", lambda *words: complaints.append(words))
    torch.compiler.reset()  # after many compilations of other tests it would compile no more
    data, ends = data_of(make_dataset()), []
    plain = torch.nn.Module.compile
    monkeypatch.setattr(torch.nn.Module, "compile", compile_network)
    for compiled in (False, True):
        module = module_of(data, compile=compiled)
        trainer_of(tmp_path / str(compiled), 2).fit(module, data)
        ends.append(module.state_dict())
    assert list(ends[0]) == list(ends[1])
    assert all(torch.equal(one, other) for one, other in zip(ends[0].values(), ends[1].values(), strict=True))
    assert bool(complaints) == (backend == "broken")
