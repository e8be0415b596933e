"""Every limit that Lightning allows either ends the training with its learning rate at zero, or is refused."""

import functools
import math
import re

import lightning
import pytest
import torch
from test_training import data_of, module_of

from nmpm.errors import ConfigError
from nmpm.optimizers import SOAP
from nmpm.training.budget import check_endless_batches
from nmpm.training.schedules import Schedule


class Rates(lightning.Callback):
    def __init__(self):
        self.seen = []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.seen.append(trainer.optimizers[0].param_groups[0]["lr"])


def trainer_with(root, *callbacks, **limits) -> lightning.Trainer:
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "limit_val_batches": 0}
    quiet |= {"enable_model_summary": False, "check_val_every_n_epoch": None, "num_sanity_val_steps": 0}
    return lightning.Trainer(accelerator="cpu", default_root_dir=root, callbacks=list(callbacks), **quiet, **limits)


SHORT = "00:00:00:02"
TRAIN = [
    ({"max_steps": 6}, 6),
    ({"max_steps": 6, "max_epochs": -1}, 6),
    ({"max_steps": 6, "max_epochs": 1}, 6),
    ({"max_steps": 6, "max_epochs": 9, "limit_train_batches": 4}, 6),
    ({"max_steps": 99, "max_epochs": 2, "limit_train_batches": 3}, 6),
    ({"max_steps": -1, "max_epochs": 2, "limit_train_batches": 3}, 6),
    ({"max_epochs": 2, "limit_train_batches": 3}, 6),
    ({"max_epochs": 2, "limit_train_batches": 3, "accumulate_grad_batches": 2}, 4),
    ({"max_steps": 6, "max_time": "00:01:00:00"}, 6),
    ({"max_epochs": 2, "limit_train_batches": 3, "max_time": "00:01:00:00"}, 6),
    ({"max_time": SHORT}, None),
    ({"max_time": SHORT, "max_steps": -1}, None),
    ({"max_time": SHORT, "max_epochs": 1}, None),
    ({"max_time": SHORT, "max_epochs": -1, "max_steps": -1, "limit_train_batches": 5}, None),
    ({"max_time": SHORT, "max_steps": 10**6}, None),
]


@pytest.mark.parametrize(("limits", "steps"), TRAIN, ids=str)
def test_a_budget_ends_the_training_with_the_rate_at_zero(make_dataset, tmp_path, limits, steps):
    data, rates = data_of(make_dataset()), Rates()
    model = module_of(data, unroll_growth=0.5, schedule=Schedule(warmup=1))
    trainer = trainer_with(tmp_path, rates, **limits)
    check_endless_batches(trainer)
    trainer.fit(model, data)
    assert all(0 <= rate <= 1e-3 for rate in rates.seen)
    assert max(rates.seen) > 0.5e-3
    assert trainer.optimizers[0].param_groups[0]["lr"] < 2e-5
    if steps is None:
        assert trainer.global_step > 0  # how many depends on the machine
    else:
        assert trainer.global_step == steps


REFUSED = [
    ({}, "has no end.*max_steps N.*max_time"),
    ({"max_epochs": 1}, "has no end"),
    ({"max_epochs": 1, "max_steps": -1}, "has no end"),
    ({"max_epochs": -1, "max_steps": -1}, "has no end"),
    ({"max_epochs": -1, "limit_train_batches": 4}, "has no end"),
    ({"max_steps": 0}, "max_steps 0: nothing"),
    ({"max_epochs": 0, "limit_train_batches": 4}, "max_epochs 0: nothing"),
    ({"max_steps": 4, "limit_train_batches": 0}, "limit_train_batches 0: nothing"),
    ({"max_time": "00:00:00:00"}, "max_time 0: nothing"),
    ({"max_steps": 4, "limit_train_batches": 0.5}, "limit_train_batches 0.5 is a share"),
]


@pytest.mark.parametrize(("limits", "complaint"), REFUSED, ids=str)
def test_a_budget_without_end_or_steps_is_refused_before_data_are_loaded(tmp_path, limits, complaint):
    with pytest.raises(ConfigError) as refusal:
        check_endless_batches(trainer_with(tmp_path, **limits))
    assert re.search(complaint, str(refusal.value))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("limits", [{"max_epochs": 1}, {"max_epochs": -1, "max_steps": -1}], ids=str)
def test_endless_trainings_are_refused_without_the_command_line_too(make_dataset, tmp_path, limits):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match="has no end"):
        trainer_with(tmp_path, **limits).fit(module_of(data), data)


def test_a_timer_that_waits_for_the_end_of_an_endless_epoch_does_not_count(tmp_path):
    by_epoch = lightning.pytorch.callbacks.Timer(SHORT, interval="epoch")
    with pytest.raises(ConfigError, match="has no end"):
        check_endless_batches(trainer_with(tmp_path, by_epoch))
    check_endless_batches(trainer_with(tmp_path, by_epoch, max_steps=3))


@pytest.mark.parametrize("rate", [-1e-3, 0.0, math.inf, math.nan])
@pytest.mark.parametrize("kind", [torch.optim.Adam, SOAP])
def test_learning_rates_that_are_not_positive_are_refused(make_dataset, tmp_path, kind, rate):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match=r"must be a positive number|Invalid learning rate"):
        trainer_with(tmp_path, max_steps=1).fit(module_of(data, optimizer=functools.partial(kind, lr=rate)), data)
