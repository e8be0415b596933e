"""A training that would fail at its end is refused before its first step, in one line."""

import shutil
from collections import namedtuple

import h5py
import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint

from nmpm.data.format import write_split
from nmpm.errors import ConfigError, DataError
from nmpm.metrics import MSE, RolloutMetric
from nmpm.processors import UNet
from nmpm.training import preflight
from tests.made_up import made_up_trajectory
from tests.trainings import QUIET, data_of, module_of, trainer_of


def fit(folder, *callbacks: lightning.Callback, metrics=None, **options) -> lightning.Trainer:
    steps = {"check_val_every_n_epoch": None, "val_check_interval": 2, "max_steps": 2}
    given = {"accelerator": "cpu", "default_root_dir": folder.parent / "run", **QUIET, **steps, **options}
    trainer = lightning.Trainer(callbacks=list(callbacks), **given)
    data = data_of(folder)
    trainer.fit(module_of(data, **({} if metrics is None else {"metrics": metrics})), data)
    return trainer


def refusal(error: type[Exception], *arguments, **options) -> str:
    with pytest.raises(error) as refused:
        fit(*arguments, **options)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_without_a_valid_split_the_last_training_trajectory_validates(make_dataset, caplog):
    folder = make_dataset(train=((14, 5), (14, 6), (14, 7)), valid=())
    caplog.set_level("INFO")
    data = fit(folder).datamodule
    assert "train.h5, trajectory 00002, validates and is not trained on." in caplog.text
    assert [window.mask.shape[1] for window in data.val_dataloader()] == [7]
    assert len(data.data_source.training_data(4, data.reading, batch_size=1, buffer_size=1, passes=1, seed=0)[0]) == 2
    everything = fit(folder, limit_val_batches=0)
    assert len(everything.train_dataloader.buffer.plan.frames) == 3


def test_of_a_single_trajectory_the_last_fifth_validates(make_dataset, caplog):
    folder = make_dataset(train=((20, 5),), valid=(), fields=("temperature",))
    caplog.set_level("INFO")
    data = fit(folder).datamodule
    assert "train.h5, trajectory 00000, frames 16 to 19, validates and is not trained on." in caplog.text
    (window,) = data.val_dataloader()
    (whole,) = data_of(folder).recordings("train")
    assert torch.equal(window.frames[0], whole.frames[16:])
    assert torch.equal(window.fields["temperature"][0], whole.fields["temperature"][16:])
    (trained,) = data.data_source.recordings("train")
    assert torch.equal(trained.frames, whole.frames[:16])


@pytest.mark.parametrize("split", ["train", "valid", "test"])
@pytest.mark.parametrize(("frame", "value", "complaint"), [(0, np.inf, "be finite"), (11, 9.0, "outside the domain")])
def test_the_ends_of_every_trajectory_are_looked_at(make_dataset, split, frame, value, complaint):
    folder = make_dataset(**{split: ((12, 5), (12, 5))})
    data = data_of(folder)
    _ = data.scene  # of the data as they were: a sample of the training split is read for it
    with h5py.File(folder / f"{split}.h5", "r+") as file:
        file["00001/position"][frame, 2] = value
    with pytest.raises(DataError, match=rf"{split}.h5, trajectory 00001: .*in frame {frame} is .*{complaint}"):
        data.setup("fit")


def test_trajectories_that_cannot_be_tested_are_refused(make_dataset):
    folder = make_dataset(test=((2, 5), (2, 5)))
    assert "an evaluation needs 3" in refusal(DataError, folder)
    strange = made_up_trajectory(12, 5)
    strange.particle_type[:] = 99
    write_split(folder / "test.h5", [strange])
    assert "99" in refusal(DataError, folder)


@pytest.mark.parametrize("kind", [ModelCheckpoint, EarlyStopping])
def test_an_error_that_is_never_logged_is_not_monitored(make_dataset, kind):
    folder = make_dataset()
    message = refusal(ConfigError, folder, kind(monitor="valid/mse@40"))
    assert f"{kind.__name__} monitors valid/mse@40, which is never logged; there are " in message
    assert "Did you mean valid/mse@4" in message
    assert fit(folder, kind(monitor="valid/mse@4")).global_step == 2


def test_values_that_a_users_callback_logs_can_be_monitored(make_dataset):
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
    message = refusal(ConfigError, make_dataset(), metrics=[MSE(), Picky()])
    assert "test.h5, trajectory 00001 (IndexError: no such particle)" in message


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
        preflight.check_disk(trainer, module)
    leave(50)
    with pytest.warns(UserWarning, match="50 MB"):
        preflight.check_disk(trainer, module)


def test_a_grid_that_does_not_fit_into_memory_is_refused_with_one_that_does(make_dataset, tmp_path, monkeypatch):
    data = data_of(make_dataset(dim=3))
    module = module_of(data, cells=64, unroll=2, processor=UNet(width=24, depth=3))
    trainer = lightning.Trainer(accelerator="cpu", default_root_dir=tmp_path / "run", logger=False, max_steps=1)
    monkeypatch.setattr(preflight, "free_memory", lambda: 2e9)
    with pytest.raises(ConfigError, match=r"64 x 64 x 64 cells takes about 6 GB .* give --model.cells 40"):
        preflight.check_memory(trainer, module.emulator, bundles=module.unroll, batch_size=4)
    small = module_of(data, cells=40, processor=UNet(width=24, depth=3))
    preflight.check_memory(trainer, small.emulator, bundles=small.unroll, batch_size=4)


@pytest.mark.parametrize("emulated", [True, False])
def test_mixed_bfloat16_is_replaced_or_warned_of_where_it_is_emulated(emulated, make_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(preflight, "computes_bfloat16", lambda device: device.type != "cpu" or not emulated)
    for name in ("bf16-mixed", "bf16", "32-true", "64-true"):
        replaced = emulated and "bf16" in name
        assert preflight.fitting_precision(name, torch.device("cpu")) == ("32-true" if replaced else name)
        assert preflight.fitting_precision(name, torch.device("cuda")) == name
    warnings = []
    monkeypatch.setattr(preflight, "rank_zero_warn", warnings.append)
    for precision in ("bf16-mixed", "32-true"):
        preflight.warn_of_slow_precision(trainer_of(tmp_path, 1, precision=precision))
    assert len(warnings) == emulated
    assert all("emulated on this processor" in text and 'precision="32-true"' in text for text in warnings)
