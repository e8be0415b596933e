"""A training says early how far its time reaches, and its validations take a bounded share of it."""

import re
from types import SimpleNamespace

import lightning
import pytest

from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.training.callbacks import forecast
from nmpm.training.callbacks.forecast import MEASURED, SKIPPED, Forecast
from tests.trainings import module_of

DECIDED = SKIPPED + MEASURED + 1


@pytest.fixture
def set_pace(monkeypatch):
    """Makes all trainings run at so many seconds per step, as far as `Forecast` sees."""
    return lambda seconds: monkeypatch.setattr(forecast.statistics, "median", lambda _: seconds)


class StopAfter(lightning.Callback):
    def __init__(self, steps: int):
        self.steps = steps

    def on_train_batch_end(self, trainer, *_):
        trainer.should_stop = trainer.global_step >= self.steps


def fit(folder, last: int, ckpt_path=None, data=None, **limits) -> lightning.Trainer:
    """Train up to a step."""
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    quiet |= {"check_val_every_n_epoch": None, "enable_checkpointing": False, "val_check_interval": 10**6}
    trainer = lightning.Trainer(
        accelerator="cpu",
        default_root_dir=folder.parent / "run",
        callbacks=[Forecast(), StopAfter(last)],
        **(quiet | limits),
    )
    module = TrajectoryDataModule(path=str(folder), horizon=4, batch_size=2, eval_batch_size=2, **(data or {}))
    trainer.fit(module_of(module), module, ckpt_path=ckpt_path, weights_only=True)
    return trainer


LONG = {"max_steps": 10**6, "max_time": "00:01:00:00", "limit_val_batches": 0}


def test_a_training_that_time_ends_early_says_so_once(make_dataset, set_pace, capsys):
    set_pace(10.0)
    fit(make_dataset(), DECIDED + 3, **LONG)
    said = capsys.readouterr().out
    (line,) = re.findall(r"At 10 s a step, max_time ends this training after about (\d+) of 1000000 steps.*\n", said)
    assert DECIDED + 360 - 10 <= int(line) <= DECIDED + 360
    assert "a larger error" in said
    assert re.search(r"--trainer\.max_time 115:\d\d:\d\d:00; for faster steps: ", said)


@pytest.mark.parametrize(("pace", "steps"), [(0.001, 10**6), (10.0, 500)], ids=["fast", "few steps"])
def test_one_whose_time_reaches_far_enough_says_nothing(make_dataset, set_pace, capsys, pace, steps):
    set_pace(pace)
    fit(make_dataset(), DECIDED + 3, **(LONG | {"max_steps": steps}))
    assert capsys.readouterr().out == ""


VALID = {"valid": ((12, 5),) * 24}
BOUNDED = {"max_steps": 30, "val_check_interval": 25}


def test_validations_take_a_fifth_of_the_time_of_steps_also_when_it_goes_on(make_dataset, set_pace, tmp_path, capsys):
    """24 trajectories of 10 frames cost as much as 10 of the 30 steps: a step has 8 frames, and gradients."""
    folder = make_dataset(**VALID)
    set_pace(1.0)
    begun = fit(folder, 28, **BOUNDED)
    begun.save_checkpoint(tmp_path / "last.ckpt")
    (count,) = re.findall(r"Validations on all 24 .* the first (\d+) \(--data\.limit_eval", capsys.readouterr().out)
    assert int(count) == 14
    used = tuple((index, index + 1) for index in range(0, 14, 2))
    assert begun.val_dataloaders.batches == used
    begun.validate(begun.lightning_module, datamodule=begun.datamodule, verbose=False)
    assert sum(begun.num_val_batches) == 7  # the last weights are compared with those before
    resumed = fit(folder, 30, tmp_path / "last.ckpt", **BOUNDED)
    assert resumed.datamodule.validated == 14
    assert resumed.val_dataloaders.batches == used


@pytest.mark.parametrize(
    "unbounded",
    [
        {"data": {"limit_eval": 24}},
        {"limit_val_batches": 12},
        {"val_check_interval": 10},  # the first validation came before there was a pace
        {"max_steps": 10**4, "val_check_interval": 10**3},
    ],
    ids=str,
)
def test_validations_that_the_user_bounds_or_that_cost_little_are_left_alone(make_dataset, set_pace, capsys, unbounded):
    set_pace(1.0)
    trainer = fit(make_dataset(**VALID), 26, **(BOUNDED | unbounded))
    assert capsys.readouterr().out == ""
    assert trainer.datamodule.validated == 24


def test_the_last_validation_is_within_max_time(make_dataset, set_pace):
    set_pace(10.0)
    trainer = fit(make_dataset(**VALID), DECIDED + 1, **(LONG | {"limit_val_batches": 1.0}))
    (timer,) = (one for one in trainer.callbacks if isinstance(one, lightning.pytorch.callbacks.Timer))
    assert 3440 < timer._duration < 3520  # a validation takes 100 s


def test_the_closing_test_is_announced(make_dataset, set_pace, capsys):
    set_pace(10.0)
    trainer = fit(make_dataset(), DECIDED + 1, **LONG)
    capsys.readouterr()
    trainer.test(trainer.lightning_module, datamodule=trainer.datamodule, verbose=False)
    said = capsys.readouterr().out
    # 33 frames of rollouts, and 24 in 10 s
    assert said.startswith("The closing test takes about 0:00:14 (--trainer.limit_test_batches N shortens it).")


@pytest.mark.parametrize(("seconds", "interval"), [(2.0, 20.0), (30.0, 150.0)])
def test_after_a_long_validation_of_the_start_they_come_more_rarely(seconds, interval, monkeypatch):
    trainer = SimpleNamespace(global_step=0, _val_check_time_interval=20.0, sanity_checking=False, datamodule=None)
    guard, times = Forecast(), iter((0.0, seconds))
    guard.on_train_start(trainer, None)
    monkeypatch.setattr(forecast.time, "monotonic", lambda: next(times))
    guard.on_validation_start(trainer, None)
    guard.on_validation_end(trainer, None)
    assert trainer._val_check_time_interval == interval
