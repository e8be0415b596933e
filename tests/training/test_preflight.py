"""What would fail at the end of a training is refused before its first step, in one line."""

import shutil
from collections import namedtuple

import h5py
import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from test_training import data_of, module_of

from nmpm.data.format import write_split
from nmpm.errors import ConfigError, DataError
from nmpm.metrics import MSE, RolloutMetric
from nmpm.training.preflight import Preflight, check_disk
from tests.made_up import made_up_trajectory


class Steps(lightning.Callback):
    """Counts the steps that are begun."""

    def __init__(self):
        self.begun = 0

    def on_train_batch_start(self, *_):
        self.begun += 1


def fit(folder, *callbacks: lightning.Callback, metrics=None, **options) -> lightning.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    quiet |= {"check_val_every_n_epoch": None, "val_check_interval": 2, "num_sanity_val_steps": 0, "max_steps": 2}
    trainer = lightning.Trainer(
        accelerator="cpu",
        default_root_dir=folder.parent / "run",
        callbacks=[*callbacks, Preflight()],
        **(quiet | options),
    )
    data = data_of(folder)
    trainer.fit(module_of(data, **({} if metrics is None else {"metrics": metrics})), data)
    return trainer


def refusal(error: type[Exception], *arguments, **options) -> str:
    with pytest.raises(error) as refused:
        fit(*arguments, **options)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_without_a_valid_split_it_trains_without_validations_alone(make_dataset):
    folder = make_dataset(valid=())
    assert "no valid.h5 there" in (said := refusal(DataError, folder))
    assert "--trainer.limit_val_batches 0" in said
    assert fit(folder, limit_val_batches=0).global_step == 2


@pytest.mark.parametrize("split", ["train", "valid", "test"])
@pytest.mark.parametrize("frame", [0, 11])
@pytest.mark.parametrize(("value", "complaint"), [(np.nan, "must be finite"), (9.0, "outside the domain")])
def test_the_ends_of_every_trajectory_are_looked_at(make_dataset, split, frame, value, complaint):
    folder = make_dataset(**{split: ((12, 5), (12, 5))})
    data = data_of(folder)
    _ = data.scene  # of the data as they were: a sample of the training split is read for it
    with h5py.File(folder / f"{split}.h5", "r+") as file:
        file["00001/position"][frame, 2] = value
    with pytest.raises(DataError, match=rf"{split}.h5, trajectory 00001: .*in frame {frame} is .*{complaint}"):
        data.setup("fit")


@pytest.mark.parametrize("split", ["valid", "test"])
def test_a_trajectory_with_nothing_to_predict_is_refused(make_dataset, split):
    assert "an evaluation needs 3" in refusal(DataError, make_dataset(**{split: ((12, 5), (2, 5))}))


def test_a_test_split_of_another_material_is_refused(make_dataset):
    folder = make_dataset()
    strange = made_up_trajectory(12, 5, 0, 0, 2)
    strange.particle_type[:] = 99
    write_split(folder / "test.h5", [strange])
    assert "99" in refusal(DataError, folder)


@pytest.mark.parametrize("kind", [ModelCheckpoint, EarlyStopping])
def test_an_error_that_is_never_logged_is_not_monitored(make_dataset, kind):
    folder = make_dataset()
    said = refusal(ConfigError, folder, kind(monitor="valid/mse@40"))
    assert f"{kind.__name__} monitors valid/mse@40, which is never logged; there are " in said
    assert "valid/mse@4" in said
    assert fit(folder, kind(monitor="valid/mse@4")).global_step == 2


def test_what_a_users_callback_may_log_can_be_monitored(make_dataset):
    class Logs(lightning.Callback):
        def on_validation_epoch_end(self, trainer, pl_module):
            pl_module.log("mine", 1.0)

    assert fit(make_dataset(), Logs(), ModelCheckpoint(monitor="mine")).global_step == 2


class Picky(RolloutMetric):
    cheap = False

    def update(self, window, predicted):
        raise IndexError("no such particle")

    def compute(self) -> dict[str, torch.Tensor]:
        return {}


def test_a_metric_that_does_not_take_the_data_is_refused(make_dataset):
    steps = Steps()
    said = refusal(ConfigError, make_dataset(), steps, metrics=[MSE(), Picky()])
    assert "test.h5, trajectory 00001 (IndexError: no such particle)" in said
    assert steps.begun == 0


@pytest.mark.parametrize("option", ["limit_val_batches", "limit_test_batches"])
def test_a_share_of_the_batches_that_is_none_is_refused(make_dataset, option):
    assert f"--trainer.{option} 0.1 of " in refusal(ConfigError, make_dataset(), **{option: 0.1})


def test_a_full_disk_is_refused_and_a_nearly_full_one_is_warned_of(make_dataset, tmp_path, monkeypatch):
    module = module_of(data_of(make_dataset()))
    trainer = lightning.Trainer(accelerator="cpu", default_root_dir=tmp_path / "run", logger=False, max_steps=1)

    def leave(megabytes: int) -> None:
        usage = namedtuple("usage", "free")(megabytes << 20)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)

    leave(10)
    with pytest.raises(ConfigError, match=r"run: 10 MB of disk are free; checkpoints and report need up to 32 MB"):
        check_disk(trainer, module)
    leave(50)
    with pytest.warns(UserWarning, match="50 MB"):
        check_disk(trainer, module)
