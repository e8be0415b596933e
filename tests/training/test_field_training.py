"""Trainings on data with fields: metrics, resuming, and other data than the model's."""

import h5py
import numpy as np
import pytest
import torch

from nmpm.errors import ConfigError
from nmpm.metrics import FieldMSE
from nmpm.training import EmulatorModule
from nmpm.training.module import load_module
from nmpm.zoo.pretrained import Pretrained
from tests.scenes import box, cloud, window_of
from tests.trainings import data_of, module_of, trainer_of


@pytest.fixture
def heated(make_dataset):
    return make_dataset(fields=("temperature",))


def test_the_metric_is_a_mean_over_trajectories_beside_nothing_changing():
    target, state = torch.arange(4.0).view(1, 4, 1).expand(1, 4, 3), cloud(box(), count=3)
    state.mask[:, 2] = False
    window = window_of(state, state.position.unsqueeze(1).expand(-1, 4, -1, -1))
    window.fields = {"heat": target}
    metric = FieldMSE(["heat"])
    for shift in (1.0, 3.0):
        metric.update(window, {"heat": target[:, 2:] + shift})
    assert {name: float(value) for name, value in metric.compute().items()} == {
        "mse_heat": 5.0,
        "still/mse_heat": 2.5,
    }
    empty = FieldMSE([])
    empty.update(window, {})
    assert empty.compute() == {}


def test_a_resumed_training_with_fields_ends_with_the_same_weights(heated, tmp_path):
    def made():
        return module_of(data_of(heated)), data_of(heated)

    whole, resumed = made(), made()
    assert whole[0].emulator.scene.evolving == ("temperature",)
    trainer_of(tmp_path / "whole", 6).fit(*whole)
    trainer_of(tmp_path / "parts", 4).fit(*made())
    trainer_of(tmp_path / "parts", 6).fit(*resumed, ckpt_path=tmp_path / "parts" / "last.ckpt", weights_only=True)
    for name, value in whole[0].state_dict().items():
        assert torch.equal(value, resumed[0].state_dict()[name]), name
    loaded = load_module(tmp_path / "parts" / "last.ckpt").emulator
    assert loaded.scene == whole[0].emulator.scene
    assert torch.equal(loaded.field_scales.mean, whole[0].emulator.field_scales.mean)
    without = data_of(heated, fields=[])
    with pytest.raises(ConfigError, match="trained with the fields temperature, the model has none"):
        trainer_of(tmp_path, 1).test(module_of(without), without, ckpt_path=tmp_path / "parts" / "last.ckpt")


def test_models_with_more_and_with_fewer_fields_than_the_data_are_tested(heated, tmp_path):
    with_heat, without = data_of(heated), data_of(heated, fields=[])
    more, fewer = module_of(with_heat), module_of(without)
    [errors] = trainer_of(tmp_path, 1).test(more, with_heat, verbose=False)
    assert {"test/mse", "test/mse_temperature", "test/still/mse_temperature"} <= set(errors)
    with pytest.warns(UserWarning, match="The scene has no temperature, which the model was trained with"):
        [errors] = trainer_of(tmp_path, 1).test(EmulatorModule.of(more.emulator), without, verbose=False)
    assert "test/mse_temperature" not in errors
    with pytest.warns(UserWarning, match="trained without temperature and ignores it"):
        [errors] = trainer_of(tmp_path, 1).test(fewer, with_heat, verbose=False)
    assert "test/mse" in errors


def test_predictions_hold_positions_and_fields(heated, tmp_path):
    data = data_of(heated)
    [first, *_] = trainer_of(tmp_path, 1).predict(module_of(data), data)
    assert first.fields["temperature"].shape == first.position.shape[:-1]


def test_states_take_fields_by_name(heated):
    data = data_of(heated)
    model = Pretrained(module_of(data).emulator.eval(), {})
    with pytest.warns(UserWarning, match="trained without mood and ignores it"):
        state = model.state(np.full((4, 2), 0.5), fields={"temperature": np.arange(4.0), "mood": 1.0})
    assert state.fields["temperature"].tolist() == [[0.0, 1.0, 2.0, 3.0]]
    assert model.state(np.full((4, 2), 0.5), fields={"temperature": 2.0}).fields["temperature"].shape == (1, 4)
    with h5py.File(heated / "test.h5") as file:
        assert "temperature" in file["00000"]
