"""The line of progress, and that training asks the device for nothing between two logged steps."""

import os
import pty
import select
import sys
import traceback

import pytest
import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import CSVLogger
from test_training import Questions, data_of, module_of

from nmpm.evaluation.figures import with_unit
from nmpm.optimizers import SOAP
from nmpm.training.callbacks.divergence import DivergenceGuard
from nmpm.training.callbacks.last_checkpoint import LastCheckpoint
from nmpm.training.callbacks.progress import Progress
from nmpm.training.callbacks.report import ReportWriter


def trainer_with(root, *callbacks: Callback, **limits) -> Trainer:
    quiet = {"enable_checkpointing": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    quiet |= {"check_val_every_n_epoch": None, "log_every_n_steps": 10, "limit_val_batches": 0}
    return Trainer(
        accelerator="cpu",
        default_root_dir=root,
        logger=CSVLogger(root),
        gradient_clip_val=1.0,
        callbacks=list(callbacks),
        **(quiet | limits),
    )


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
    guards = [
        LearningRateMonitor("step"),
        Progress(),
        DivergenceGuard(),
        ReportWriter(),
        LastCheckpoint(tmp_path, "last", every_n_train_steps=1000),
    ]
    trainer = trainer_with(tmp_path, *guards, max_steps=25, precision="bf16-mixed", enable_checkpointing=True)
    with Readings(trainer) as readings:
        trainer.fit(module_of(data, optimizer=optimizer, mirror=(0,)), data)
    assert readings.steps == {0, 10, 20, 25}


def shown(capsys) -> list[str]:
    return [line.strip() for line in capsys.readouterr().out.replace("\r", "\n").split("\n") if "step" in line]


def test_the_line_says_steps_time_left_loss_and_the_validation_error(make_dataset, tmp_path, capsys):
    data = data_of(make_dataset())
    trainer = trainer_with(tmp_path, Progress(), max_steps=20, limit_val_batches=1, val_check_interval=10)
    trainer.fit(module_of(data), data)
    last = shown(capsys)[-1]
    loss, error = (float(trainer.callback_metrics[name]) for name in ("train/loss", "valid/mse"))
    assert last.startswith("100% |")
    assert last.endswith(f"training: step 20/20, 0:00:00 left, loss {loss:.3g}, validation error {with_unit(error)}")


def test_with_time_alone_it_says_the_time_left(make_dataset, tmp_path, capsys):
    data = data_of(make_dataset())
    trainer = trainer_with(tmp_path, Progress(), max_time="00:00:00:02")
    trainer.fit(module_of(data), data)
    last = shown(capsys)[-1]
    assert last.startswith("100% |")
    assert f"training: step {trainer.global_step}, 0:00:00 left" in last


@pytest.mark.parametrize(
    ("limits", "end"),
    [({"max_steps": 4, "max_time": "01:00:00:00"}, "the last step"), ({"max_steps": 10**9}, "max_time")],
    ids=["steps", "time"],
)
def test_with_both_it_says_which_ends_the_training(make_dataset, tmp_path, capsys, limits, end):
    data = data_of(make_dataset())
    trainer_with(tmp_path, Progress(), **({"max_time": "00:00:00:02"} | limits)).fit(module_of(data), data)
    assert f"0:00:00 left to {end}, " in shown(capsys)[-1] + ", "


def read_until(controller: int, words: str) -> str:
    """What a terminal shows, until the words or nothing for 10 seconds: it may arrive in pieces, after the flush."""
    shown = b""
    while words.encode() not in shown and select.select([controller], [], [], 10)[0]:
        shown += os.read(controller, 65536)
    return shown.decode(errors="replace")


def test_a_terminal_without_a_width_shows_the_line_nevertheless(make_dataset, tmp_path, monkeypatch):
    """As in some containers, where a terminal states 0 columns."""
    controller, terminal = pty.openpty()
    data = data_of(make_dataset())
    trainer = trainer_with(tmp_path, Progress(), max_steps=2)
    with os.fdopen(terminal, "w") as screen, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", screen)
        trainer.fit(module_of(data), data)
        screen.flush()
        shown = read_until(controller, "step 2/2")
    os.close(controller)
    assert "step 2/2" in shown


def test_an_evaluation_in_a_file_ends_its_line_and_says_what_is_left(capsys):
    progress = Progress()
    progress._bar = progress._open("testing", 2)
    progress._count_batch()
    progress._count_batch()
    progress._close()
    said = capsys.readouterr().out
    assert said.endswith("\n")
    assert "testing 2/2, 00:00 left" in said
