"""Trainings are in bfloat16 where a device has instructions for it, and in float32 elsewhere."""

import json
import warnings
from pathlib import Path

import pytest
import torch

from nmpm.cli import main
from nmpm.training import precision
from tests.training.test_training import data_of, module_of, trainer_of

CPU = torch.device("cpu")
WORDS = [
    *("fit", "--config", "waterdrop.yaml", "--trainer.max_steps", "1", "--trainer.val_check_interval", "1"),
    *("--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false", "--data.batch_size", "2"),
    *("--model.unroll", "1", "--trainer.default_root_dir", "run", "--data.path"),
]


@pytest.fixture(params=[True, False], ids=["instructions", "none"])
def instructions(request, monkeypatch) -> bool:
    monkeypatch.setattr(precision, "computes_bfloat16", lambda device: request.param or device.type != "cpu")
    return request.param


def test_mixed_bfloat16_is_replaced_on_processors_without_instructions_alone(instructions):
    for name in ("bf16-mixed", "bf16"):
        assert precision.fitting_precision(name, CPU) == (name if instructions else "32-true")
        assert precision.fitting_precision(name, torch.device("cuda")) == name
    for name in ("32-true", "64-true", "bf16-true"):
        assert precision.fitting_precision(name, CPU) == name


def test_a_shipped_configuration_trains_in_what_the_processor_computes_and_says_so(
    instructions, make_dataset, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    made = make_dataset(train=((40, 9),), valid=((40, 9),), test=((40, 9),))
    assert main([*WORDS, str(made)]) == 0
    used = "bf16-mixed" if instructions else "32-true"
    assert json.loads(Path("run/report.json").read_text())["training"]["precision"] == used
    said = "Computed in 32-true: this processor has no instructions for bfloat16" in capsys.readouterr().out
    assert said is not instructions


def test_a_trainer_of_ones_own_in_slow_bfloat16_is_warned_of(instructions, make_dataset, tmp_path):
    data = data_of(make_dataset())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        trainer_of(tmp_path, 1, precision="bf16-mixed").fit(module_of(data), data)
        trainer_of(tmp_path, 1, precision="32-true").fit(module_of(data), data)
    found = [str(one.message) for one in caught if "no instructions for bfloat16" in str(one.message)]
    assert len(found) == (0 if instructions else 1)
    assert all('precision="32-true"' in text for text in found)
