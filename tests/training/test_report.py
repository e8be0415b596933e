from types import SimpleNamespace

import pytest
import torch

from nmpm._support.machine import device_name
from nmpm.evaluation.figures import no_better_than_trivial
from nmpm.training.callbacks.outputs import ReportWriter

TRIVIAL = {"still/mse": 0.02, "free_fall/mse": 0.01}


@pytest.mark.parametrize("error", [0.01, float("nan")])
def test_a_model_that_is_no_better_than_a_trivial_predictor_is_said_to_be_so(error):
    remark = no_better_than_trivial({"mse": error, "mse@8": 0.0} | TRIVIAL)
    assert remark.startswith("The model is no better than a trivial predictor")
    assert "'free fall, stopped at walls' 10 ×10⁻³" in remark
    assert no_better_than_trivial({"mse": 0.009} | TRIVIAL) == no_better_than_trivial({"mse": error}) == ""


EMULATOR = SimpleNamespace(frames=8, parameters=lambda: iter(()))
MODULE = SimpleNamespace(emulator=EMULATOR, unroll=2, state_dict=dict, threads=None, ensemble=None)


def trainer_on(device: str) -> SimpleNamespace:
    return SimpleNamespace(
        strategy=SimpleNamespace(root_device=torch.device(device)),
        datamodule=SimpleNamespace(description="made up"),
        callback_metrics={"test/mse": torch.tensor(1.0)},
        precision="32-true",
        world_size=1,
    )


def test_a_report_names_all_devices_that_a_training_ran_on_and_not_the_one_that_tests_it(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: f"GPU of {device}")
    assert device_name(torch.device("cpu"), 2).endswith(", 2 threads")
    written = ReportWriter()
    for device in ("cuda:0", "cuda:1", "cuda:0"):
        writer = ReportWriter()
        writer.load_state_dict(written.state_dict())
        writer.on_train_start(trainer_on(device), None)
        written = writer
    tested = ReportWriter()
    tested.load_state_dict(written.state_dict())
    assert tested._figures(trainer_on("cpu"), MODULE, {})["training"]["hardware"] == "GPU of cuda:0; GPU of cuda:1"
    assert "thread" in ReportWriter()._figures(trainer_on("cpu"), MODULE, {})["training"]["hardware"]
