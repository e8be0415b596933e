"""Progress, and that training asks the device for nothing between two logged steps."""

import re
import traceback

import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import CSVLogger

from nmpm.optimizers import SOAP
from nmpm.training.callbacks import progress
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.outputs import ReportWriter
from nmpm.training.callbacks.progress import Progress
from nmpm.training.callbacks.savers import LastCheckpoint
from tests.training.test_training import Questions
from tests.trainings import data_of, module_of, trainer_of


class Readings(Questions):
    """Steps at which a value is read back, but for the optimizer's own counters, which are on the host."""

    ASKING = ("_local_scalar_dense", "nonzero", "equal", "masked_select", "is_nonzero")

    def __init__(self, trainer: Trainer):
        super().__init__()
        self.trainer, self.steps = trainer, set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.overloadpacket.__name__ in self.ASKING:
            files = [frame.filename for frame in traceback.extract_stack()]
            if not any("torch/optim/" in file for file in files):
                self.steps.add(self.trainer.global_step)
        return super().__torch_dispatch__(func, types, args, kwargs)


@pytest.mark.parametrize("optimizer", [torch.optim.Adam, SOAP])
def test_values_are_read_back_at_the_start_at_logged_steps_and_at_the_end_alone(make_dataset, tmp_path, optimizer):
    data = data_of(make_dataset())
    guards = [Progress(), DivergenceGuard(), ReportWriter(), LearningRateMonitor("step")]
    guards.append(LastCheckpoint(tmp_path, "last", every_n_train_steps=1000))
    trainer = Trainer(
        accelerator="cpu", default_root_dir=tmp_path, logger=CSVLogger(tmp_path), gradient_clip_val=1.0,
        callbacks=guards, max_steps=25, precision="bf16-mixed", log_every_n_steps=10, limit_val_batches=0,
        enable_model_summary=False,
    )  # fmt: skip
    with Readings(trainer) as readings:
        trainer.fit(module_of(data, optimizer=optimizer, mirror=(0,)), data)
    assert readings.steps == {0, 10, 20, 25}


class Bar:
    """Stands in for `progress_bar`, and keeps what it is told."""

    def __init__(self, what: str, total: int | None, done: int):
        self.shown, self.total, self.done = [what], total, done

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.shown.append("closed")

    def __call__(self, what: str = "", by: int = 1):
        self.shown.append(what)
        self.done += by


def test_trainings_show_steps_loss_validation_error_and_time_and_evaluations_batches(
    make_dataset, tmp_path, monkeypatch
):
    bars = []
    monkeypatch.setattr(progress, "progress_bar", lambda *words: bars.append(Bar(*words)) or bars[-1])
    data, limits = data_of(make_dataset()), {"log_every_n_steps": 2, "max_time": "00:01:00:00"}
    trainer = trainer_of(tmp_path, 4, Progress(), enable_progress_bar=True, **limits)
    model = module_of(data)
    trainer.fit(model, data)
    trainer.test(model, data, verbose=False)
    training, testing = bars
    assert (training.total, training.done) == (4, 4)
    assert training.shown[0] == "training"
    assert any(text.startswith("validating, loss ") for text in training.shown)
    assert re.fullmatch(
        r"training, loss \S+, validation error .+, ends by max_steps in 0:\d\d:\d\d", training.shown[-2]
    )
    assert testing.shown == ["testing", *[""] * testing.total, "closed"]
    assert training.shown[-1] == "closed"
