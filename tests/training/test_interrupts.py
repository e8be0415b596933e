"""Ctrl-C, SIGTERM, and several processes in one folder."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from lightning.pytorch import Callback

from nmpm.cli import main
from nmpm.errors import ConfigError
from nmpm.training.run_folder import RunFolder

FIT = [
    *("fit", "--config", "waterdrop.yaml", "--config", "mine.yaml", "--model.unroll", "1"),
    *("--model.processor.width", "4", "--model.processor.perceptron", "[4]", "--data.batch_size", "2"),
    *("--trainer.accelerator", "cpu", "--trainer.precision", "32-true", "--trainer.enable_progress_bar", "false"),
]


class Kill(Callback):
    """Sends this process, once, a signal after a step or in the middle of the validation after it."""

    armed = False

    def __init__(self, kind: int, step: int, validating: bool = False):
        self.kind, self.step, self.validating = kind, step, validating

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self._kill(trainer.global_step == self.step and not self.validating)

    def on_validation_batch_start(self, trainer, *_):
        self._kill(trainer.global_step == self.step and self.validating)

    def _kill(self, due):
        if due and Kill.armed:
            Kill.armed = False
            os.kill(os.getpid(), self.kind)


@pytest.fixture
def fit(make_dataset, tmp_path, monkeypatch):
    """Trains in a folder; `kill` are the arguments of `Kill`."""
    monkeypatch.chdir(tmp_path)
    sizes = ((40, 9),) * 2
    data = str(make_dataset(train=sizes, valid=sizes, test=sizes))

    def fit(folder: str, *words: str, kill: dict | None = None) -> int:
        averaging = {"class_path": "lightning.pytorch.callbacks.EMAWeightAveraging", "init_args": {"decay": 0.5}}
        Kill.armed = bool(kill)
        killer = [{"class_path": f"{__name__}.Kill", "init_args": kill}] if kill else []
        Path("mine.yaml").write_text(yaml.safe_dump({"trainer": {"callbacks": [averaging, *killer]}}))
        steps = ["--trainer.max_steps", "8", "--trainer.val_check_interval", "4"]
        return main([*FIT, *steps, "--data.path", data, "--trainer.default_root_dir", folder, *words])

    return fit


def weights(folder: str) -> dict[str, torch.Tensor]:
    return torch.load(f"{folder}/checkpoints/best.ckpt", weights_only=True)["state_dict"]


@pytest.mark.parametrize(
    "kill",
    [
        {"kind": int(signal.SIGINT), "step": 2},
        {"kind": int(signal.SIGTERM), "step": 2},
        {"kind": int(signal.SIGINT), "step": 4, "validating": True},
    ],
    ids=str,
)
def test_an_interrupted_training_goes_on_where_it_was_by_the_command_that_it_prints(fit, capfd, kill):
    handlers = [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)]
    assert fit("run", kill=kill) == 130
    said = capfd.readouterr().err
    step = kill["step"] + (not kill.get("validating", False))
    found = re.search(rf"^nmpm fit: stopped at step {step}\. Go on with: (nmpm fit --resume run)$", said, re.M)
    assert found
    assert "Traceback" not in said
    assert torch.load("run/checkpoints/last.ckpt", weights_only=True)["global_step"] == step
    assert [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert fit("whole") == 0
    assert main(shlex.split(found[1])[1:]) == 0
    for name, value in weights("whole").items():
        assert torch.equal(value, weights("run")[name]), name


def test_an_interruption_before_training_says_that_the_same_command_starts_again(fit, monkeypatch, capfd):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("nmpm.data.datamodule.TrajectoryDataModule.prepare_data", interrupted)
    assert fit("run") == 130
    message = "interrupted before the first step. The same command starts again; simulated trajectories are kept."
    assert message in capfd.readouterr().err
    assert fit("run", "--ckpt_path", "last") == 1
    said = capfd.readouterr().err
    assert re.search(r"--ckpt_path last: there is no run/checkpoints/last\.ckpt; checkpoints there: none", said)


def folder_of(root: Path) -> RunFolder:
    return RunFolder(root, {name: root / "checkpoints" / f"{name}.ckpt" for name in ("last", "best")})


HOLD = """
import sys, time
from pathlib import Path
from nmpm.training.run_folder import RunFolder
RunFolder(Path(sys.argv[1]), {}).lock()
print("locked", flush=True)
time.sleep(60)
"""


def test_a_folder_is_trained_in_by_one_process_and_free_again_when_that_is_killed(tmp_path):
    held = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert held.stdout.readline() == "locked\n"
        with pytest.raises(ConfigError, match=rf"process \({held.pid}\) is training in"):
            folder_of(tmp_path).lock()
    finally:
        held.kill()
        held.wait()
    os.close(folder_of(tmp_path).lock())


@pytest.mark.parametrize("left", ["checkpoints/best.ckpt", "checkpoints/last.ckpt", "report.json"])
def test_what_a_run_left_is_not_written_over(tmp_path, left):
    folder = folder_of(tmp_path)
    folder.check_new()
    (tmp_path / "logs" / "a").mkdir(parents=True)
    (tmp_path / "logs" / "a" / "metrics.csv").touch()  # of a run that was killed before its first checkpoint
    folder.check_new()
    (tmp_path / left).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / left).touch()
    with pytest.raises(ConfigError, match="already holds a run") as refusal:
        folder.check_new()
    assert ("nmpm fit --resume" in str(refusal.value)) == ("last" in left)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "devices"), [(signal.SIGINT, 1), (signal.SIGTERM, 2)])
def test_a_signal_saves_the_run_of_one_or_two_processes(make_dataset, tmp_path, monkeypatch, kind, devices):
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text("seed_everything: 1\n")
    sizes = ((40, 9),) * 2
    data = ["--data.path", str(make_dataset(train=sizes, valid=sizes, test=sizes))]
    long = ["--trainer.max_steps", "100000", "--trainer.log_every_n_steps", "1", "--resume.every_n_train_steps", "9999"]
    spread = ["--trainer.devices", str(devices), "--trainer.strategy", "ddp" if devices > 1 else "auto"]
    words = [sys.executable, "-m", "nmpm", *FIT, *data, *long, *spread, "--trainer.default_root_dir", "run"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    run = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True)
    try:
        end = time.monotonic() + 120
        while not list(Path("run").glob("logs/*/events*")) and time.monotonic() < end:
            time.sleep(0.1)
        time.sleep(2)
        run.send_signal(kind)
        _, said = run.communicate(timeout=60)
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 130
    assert said.count("Go on with: nmpm fit") == 1
    assert "Traceback" not in said
    assert Path("run/checkpoints/last.ckpt").is_file()
