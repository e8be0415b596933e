"""Trainings from Python: they learn, resume to the bit, and their checkpoints stand alone."""

import dataclasses
import functools
import json

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import OnExceptionCheckpoint
from torch.utils._python_dispatch import TorchDispatchMode

from nmpm.decoders import Absolute
from nmpm.emulator.constraints import Constraints
from nmpm.emulator.rollouts import rollout
from nmpm.errors import ConfigError, NmpmError
from nmpm.metrics import MSE
from nmpm.optimizers import SOAP
from nmpm.training import EmulatorModule
from nmpm.training.callbacks.outputs import ReportWriter
from nmpm.training.losses import PositionLoss
from nmpm.training.module import load_module
from nmpm.training.optimization import Schedule
from nmpm.transfer import Nearest, without_kernels
from tests.trainings import TINY, Record, data_of, module_of, trainer_of


def assert_same_weights(one: EmulatorModule, other: EmulatorModule) -> None:
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_training_lowers_the_loss_and_reports_rollouts_beside_the_trivial_predictors(make_dataset, tmp_path):
    data, record = data_of(make_dataset()), Record()
    fast = functools.partial(torch.optim.Adam, lr=1e-2)
    plain = {"loss": PositionLoss(1.0, 0.0), "position_noise": 0.0, "grid_noise": 0.0}
    model = module_of(data, schedule=Schedule(warmup=2), optimizer=fast, **plain)
    trainer = trainer_of(tmp_path, 60, record, val_check_interval=60)
    trainer.fit(model, data)
    assert sum(record.losses[-5:]) < 0.7 * sum(record.losses[:5])
    figures = trainer.callback_metrics
    for kind in ("", "still/", "free_fall/"):
        for name in ("mse", "mse@1", "mse@4"):
            assert figures[f"valid/{kind}{name}"].isfinite()
    longer = torch.stack([figures[f"valid/{name}"] for name in ("mse@4", "mse")])  # than the 4 frames trained for
    torch.testing.assert_close(figures["valid/overall"], longer.prod().sqrt())


@pytest.mark.parametrize("optimizer", [functools.partial(torch.optim.Adam, lr=1e-3), SOAP])
def test_a_resumed_training_ends_with_the_same_weights(make_dataset, tmp_path, optimizer):
    folder = make_dataset()
    whole, part, resumed = ((module_of(data_of(folder), optimizer=optimizer), data_of(folder)) for _ in range(3))
    trainer_of(tmp_path / "whole", 10).fit(*whole)
    trainer_of(tmp_path / "parts", 6).fit(*part)
    trainer_of(tmp_path / "parts", 10).fit(*resumed, ckpt_path=tmp_path / "parts" / "last.ckpt", weights_only=True)
    assert_same_weights(whole[0], resumed[0])


class Fail(lightning.Callback):
    def on_before_zero_grad(self, trainer, pl_module, optimizer):
        if trainer.global_step == 4:
            raise RuntimeError("interrupted")


def test_a_training_interrupted_within_a_batch_resumes_with_its_random_numbers(make_dataset, tmp_path):
    data, whole, broken, resumed = data_of(make_dataset()), Record(), Record(), Record()
    trainer_of(tmp_path / "whole", 7, whole).fit(module_of(data), data)
    saving = OnExceptionCheckpoint(tmp_path, "broken")
    with pytest.raises(RuntimeError, match="interrupted"):
        trainer_of(tmp_path / "parts", 7, broken, saving, Fail()).fit(module_of(data), data)
    trainer_of(tmp_path / "rest", 7, resumed).fit(
        module_of(data), data_of(tmp_path / "dataset"), ckpt_path=tmp_path / "broken.ckpt", weights_only=True
    )
    assert len(set(whole.seeds)) == 7
    assert broken.seeds + resumed.seeds == whole.seeds


def test_a_checkpoint_stands_alone(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model = module_of(data, transfer=Nearest(), decoder=Absolute())
    trainer_of(tmp_path, 2).fit(model, data)
    loaded = load_module(tmp_path / "last.ckpt")
    assert loaded.emulator.recipe == model.emulator.recipe
    assert loaded.emulator.calibrated
    assert_same_weights(model, loaded)


@pytest.mark.filterwarnings("error:The emulator is in training mode")
def test_validations_and_tests_are_rollouts_in_evaluation_mode(make_dataset, tmp_path):
    data = data_of(make_dataset())
    module, trainer = module_of(data, constraints=Constraints(energy=True)), trainer_of(tmp_path, 2)
    trainer.fit(module, data)
    trainer.test(module, data)
    with pytest.warns(UserWarning, match="training mode"):
        rollout(EmulatorModule.of(module.emulator).emulator, next(iter(data.test_dataloader())).initial, 2)


def test_fine_tuning_starts_from_the_same_predictions_and_keeps_the_statistics(make_dataset, tmp_path):
    data = data_of(make_dataset())
    pretrained = module_of(data, transfer=Nearest()).emulator
    pretrained.output_scale.fill_(0.5)
    pretrained.calibrated.fill_(True)
    tuned, window = EmulatorModule.of(pretrained, unroll=2), next(iter(data.test_dataloader()))
    before = rollout(pretrained.eval(), window.initial, 6)
    assert torch.equal(rollout(tuned.emulator.eval(), window.initial, 6), before)
    trainer_of(tmp_path, 2).fit(tuned, data)
    assert not torch.equal(rollout(tuned.emulator.eval(), window.initial, 6), before)
    assert torch.equal(rollout(pretrained, window.initial, 6), before)
    assert (tuned.emulator.output_scale == 0.5).all()


def test_data_that_do_not_suit_the_model_are_refused(make_dataset, tmp_path):
    data = data_of(make_dataset())
    for stage in ("fit", "test"):
        model = EmulatorModule(
            dataclasses.replace(data.scene, obstacles=not data.scene.obstacles), cells=8, processor=TINY
        )
        with pytest.raises(ConfigError, match=r"obstacles = (True|False), not (True|False).*fit_to\(data\)"):
            getattr(trainer_of(tmp_path, 1), stage)(model, data)
    with pytest.raises(ConfigError, match=r"data\.horizon = 4 .* 6 frames .*frames = 2 .*unroll = 3"):
        trainer_of(tmp_path, 1).fit(module_of(data, unroll=3), data)
    trainer_of(tmp_path, 1).fit(module_of(data, unroll=1), data)  # longer windows are cut


def test_trajectories_that_are_all_shorter_than_a_window_are_an_error(make_dataset, tmp_path):
    data = data_of(make_dataset(train=((5, 5), (5, 5))))
    with pytest.raises(NmpmError, match=r"train\.h5.*5 frames"):
        trainer_of(tmp_path, 1, val_check_interval=1).fit(module_of(data), data)


def test_bundles_grow_over_the_share_of_the_training_asked_for(make_dataset, tmp_path):
    data = data_of(make_dataset(), horizon=8)
    module = module_of(data, unroll=4, unroll_growth=0.5)
    assert [module.bundles(share / 8) for share in range(9)] == [1, 1, 2, 3, 4, 4, 4, 4, 4]
    assert module_of(data, unroll=4).bundles(0.0) == 4
    unrolled = []
    module.bundles = lambda progress: unrolled.append(progress) or 1
    trainer_of(tmp_path, 4).fit(module, data)
    assert unrolled == [0.0, 0.25, 0.5, 0.75]
    with pytest.raises(ConfigError, match=r"unroll_growth = 2.*share"):
        module_of(data, unroll_growth=2.0)


def test_errors_of_a_bfloat16_training_are_those_of_the_loaded_model(make_dataset, tmp_path):
    data = data_of(make_dataset())
    model, trainer = module_of(data), trainer_of(tmp_path, 2, ReportWriter(), precision="bf16-mixed")
    trainer.fit(model, data)
    assert all(weight.dtype == torch.float32 for weight in model.parameters())
    trainer.save_checkpoint(tmp_path / "trained.ckpt")
    emulator, metric = load_module(tmp_path / "trained.ckpt").emulator.eval(), MSE()
    for window in data.test_dataloader():
        metric.update(window, rollout(emulator, window.initial, window.target.shape[1]))
    expected = sorted(row["mse"] for row in metric.per_trajectory())
    for precision in ("bf16-mixed", "32-true"):
        tester = trainer_of(tmp_path, 2, ReportWriter(), precision=precision)
        tester.test(module_of(data), data, ckpt_path=tmp_path / "trained.ckpt", weights_only=True)
        report = json.loads((tmp_path / "report.json").read_text())
        errors = sorted(row["mse"] for row in report["per_trajectory"]["model"])
        assert errors == pytest.approx(expected, rel=1e-6)
        assert report["training"]["precision"] == "bf16-mixed"


@pytest.mark.parametrize(
    ("step", "factor"), [(0, 0.01), (50, 0.505), (100, 1.0), (999, 1.0), (50_500, 0.5), (1e5, 0.0)]
)
def test_schedule_is_the_papers(step, factor):
    schedule = Schedule(warmup=100, flat=900, start=0.01)
    assert schedule.factor(step, 1e5) == pytest.approx(factor, abs=2e-6 if step else 0)


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
    window, module = next(iter(data.train_dataloader())), module_of(data)
    module.log = lambda *_, **__: None
    with without_kernels(), Questions() as questions:  # as on a device: the kernels are a CPU's
        module.training_step(window, 0).backward()
    assert questions.asked == []
    with Questions() as questions:
        assert bool(window.mask.any())
    assert questions.asked  # it does see such questions


@pytest.mark.parametrize("works", [True, False])
def test_a_compiled_network_trains_to_the_same_weights_and_a_broken_compiler_is_no_harm(
    make_dataset, tmp_path, works, monkeypatch
):
    complaints, compile_module = [], torch.nn.Module.compile

    def broken(*_):
        raise RuntimeError("no compiler here")

    def compile_network(network):
        if works:
            compile_module(network, backend="eager")
        else:  # fails in the first call, as `compile` does, whatever torch remembers of other tests' compilations
            network._compiled_call_impl = broken

    # Not by caplog: other tests of the same process may have switched loggers off.
    monkeypatch.setattr("nmpm.training.preflight._LOG.warning", lambda *words: complaints.append(words))
    torch.compiler.reset()  # after many compilations of other tests it would compile no more
    monkeypatch.setattr(torch.nn.Module, "compile", compile_network)
    data = data_of(make_dataset())
    plain, compiled = (module_of(data, compile=compiled) for compiled in (False, True))
    for name, module in (("plain", plain), ("compiled", compiled)):
        trainer_of(tmp_path / name, 2).fit(module, data)
    assert_same_weights(plain, compiled)
    assert bool(complaints) != works


@pytest.mark.parametrize("make", [lambda tensor: (tensor, tensor), lambda tensor: {"position": tensor}, lambda t: t])
@pytest.mark.parametrize("calibrated", [True, False])
def test_batches_of_a_foreign_loader_are_refused(tmp_path, make_dataset, make, calibrated):
    module = module_of(data_of(make_dataset()))
    module.emulator.calibrated.fill_(calibrated)
    loader = torch.utils.data.DataLoader([torch.zeros(6, 20, 2)], collate_fn=lambda rows: make(rows[0]))
    with pytest.raises(ConfigError, match=r"type (tuple|dict|Tensor), not .*TrajectoryDataModule\(path"):
        trainer_of(tmp_path, 2).fit(module, loader)


def test_optimizers_that_evaluate_a_step_again_are_refused(tmp_path, make_dataset):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match=r"LBFGS .*nmpm.optimizers.SOAP"):
        trainer_of(tmp_path, 2).fit(module_of(data, optimizer=torch.optim.LBFGS), data)
