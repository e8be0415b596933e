"""Every limit that Lightning allows either ends the training with its learning rate at zero, or is refused."""

import functools
import math
import re

import lightning
import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.optimizers import SOAP
from nmpm.training.budget import check_endless_batches
from nmpm.training.optimization import Schedule
from tests.trainings import QUIET, Record, data_of, module_of


def trainer_with(root, *callbacks, **limits) -> lightning.Trainer:
    quiet = {**QUIET, "enable_checkpointing": False, "limit_val_batches": 0, "check_val_every_n_epoch": None}
    return lightning.Trainer(accelerator="cpu", default_root_dir=root, callbacks=list(callbacks), **quiet, **limits)


SHORT = "00:00:00:01"


@pytest.mark.parametrize(
    ("limits", "steps"),
    [
        ({"max_steps": 6}, 6),
        ({"max_steps": 6, "max_epochs": 1, "max_time": "00:01:00:00"}, 6),
        ({"max_steps": 6, "max_epochs": 9, "limit_train_batches": 4}, 6),
        ({"max_steps": 99, "max_epochs": 2, "limit_train_batches": 3}, 6),
        ({"max_epochs": 2, "limit_train_batches": 3, "accumulate_grad_batches": 2}, 4),
        ({"max_time": SHORT}, None),
        ({"max_time": SHORT, "max_epochs": -1, "max_steps": -1, "limit_train_batches": 5}, None),
        ({"max_time": SHORT, "max_steps": 10**6}, None),
    ],
    ids=str,
)
def test_a_budget_ends_the_training_with_the_rate_at_zero(make_dataset, tmp_path, limits, steps):
    data, record = data_of(make_dataset()), Record()
    model = module_of(data, unroll_growth=0.5, schedule=Schedule(warmup=1))
    trainer = trainer_with(tmp_path, record, **limits)
    check_endless_batches(trainer)
    trainer.fit(model, data)
    assert all(0 <= rate <= 1e-3 for rate in record.rates)
    assert max(record.rates) > 0.5e-3
    assert trainer.optimizers[0].param_groups[0]["lr"] < 2e-5
    assert trainer.global_step > 0  # how many depends on the machine, if time ends them
    assert steps in (None, trainer.global_step)


BY_EPOCH = lightning.pytorch.callbacks.Timer(SHORT, interval="epoch")  # which waits for the end of an endless epoch


@pytest.mark.parametrize(
    ("limits", "callbacks", "complaint"),
    [
        ({}, [], "has no end.*max_steps N.*max_time"),
        ({"max_epochs": 1, "max_steps": -1}, [], "has no end"),
        ({"max_epochs": -1, "limit_train_batches": 4}, [], "has no end"),
        ({}, [BY_EPOCH], "has no end"),
        ({"max_steps": 0}, [], "max_steps 0: nothing"),
        ({"max_epochs": 0, "limit_train_batches": 4}, [], "max_epochs 0: nothing"),
        ({"max_time": "00:00:00:00"}, [], "max_time 0: nothing"),
        ({"max_steps": 4, "limit_train_batches": 0.5}, [], "limit_train_batches 0.5 is a share"),
    ],
)
def test_a_budget_without_end_or_steps_is_refused_before_data_are_loaded(tmp_path, limits, callbacks, complaint):
    with pytest.raises(ConfigError) as refusal:
        check_endless_batches(trainer_with(tmp_path, *callbacks, **limits))
    assert re.search(complaint, str(refusal.value))
    assert "\n" not in str(refusal.value)


def test_endless_trainings_are_refused_without_the_command_line_too(make_dataset, tmp_path):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match="has no end"):
        trainer_with(tmp_path, max_epochs=1).fit(module_of(data), data)


@pytest.mark.parametrize(("kind", "rate"), [(torch.optim.Adam, -1e-3), (SOAP, 0.0), (SOAP, math.nan)])
def test_learning_rates_that_are_not_positive_are_refused(make_dataset, tmp_path, kind, rate):
    data = data_of(make_dataset())
    with pytest.raises(ConfigError, match=r"must be a positive number|Invalid learning rate"):
        trainer_with(tmp_path, max_steps=1).fit(module_of(data, optimizer=functools.partial(kind, lr=rate)), data)
