"""The configuration of a run that somebody shares runs nothing that nmpm did not write, unless it is asked for."""

from pathlib import Path

import pytest
import yaml

from nmpm.cli import main
from nmpm.cli.trust import foreign_names
from tests.cli.test_training_commands import WATERDROP, source

EVIL = "os.abort"
PLACES = {
    "callback": ("trainer", "callbacks", [{"class_path": EVIL}]),
    "callback in short": ("trainer", "callbacks", ["subprocess.Popen"]),
    "callback's function": (
        "trainer", "callbacks",
        [{"class_path": "lightning.pytorch.callbacks.LambdaCallback", "init_args": {"on_test_start": EVIL}}],
    ),
    "logger": ("trainer", "logger", {"class_path": "lightning.pytorch.loggers.WandbLogger"}),
    "logger by name": ("trainer", "logger", "WandbLogger"),
    "plugin": ("trainer", "plugins", [{"class_path": "subprocess.Popen", "init_args": {"args": ["true"]}}]),
    "profiler": ("trainer", "profiler", {"class_path": EVIL}),
    "strategy": ("trainer", "strategy", "subprocess.Popen"),
    "processor": ("model", "processor", {"class_path": EVIL}),
    "processor in short": ("model", "processor", EVIL),
    "module of nmpm": ("model", "processor", {"class_path": "nmpm.cli.training.os.abort"}),
    "import of nmpm": ("model", "processor", {"class_path": "nmpm._support.isolated.Path"}),
    "optimizer": ("model", "optimizer", {"class_path": EVIL}),
    "schedule": (
        "model", "optimizer",
        {"class_path": "torch.optim.lr_scheduler.LambdaLR", "init_args": {"lr_lambda": EVIL}},
    ),
    "metric": ("model", "metrics", [{"class_path": EVIL}]),
    "data": ("data", "generate", {"class_path": EVIL}),
    "reference": ("model", "optimizer", {"class_path": "${seed_everything}.abort"}),
    "module here": ("model", "optimizer", {"class_path": "mine.Optimizer"}),
}  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))


def shared(section, key, value):
    """The folder of a run whose configuration has another value; neither its weights nor its data are there."""
    folder = Path("run")
    (folder / "checkpoints").mkdir(parents=True)
    for name in ("best", "last"):
        (folder / "checkpoints" / f"{name}.ckpt").write_bytes(b"")
    (folder / "config.yaml").write_text(yaml.safe_dump({"seed_everything": 0, section: {key: value}}))
    return folder


@pytest.mark.parametrize("place", PLACES)
def test_what_others_wrote_is_named_and_not_run(place, capsys):
    folder = shared(*PLACES[place])
    for words in (["test"], ["validate"], ["predict"], ["fit", "--resume"]):
        assert main([*words, str(folder)]) == 1
        said = capsys.readouterr().err
        assert "config.yaml names " in said
        assert "--trust-config" in said
        assert said.count("\n") == 1


@pytest.mark.parametrize("key", ["processor", "optimizer"])
def test_files_that_the_configuration_names_are_checked_too(key, capsys):
    folder = shared("model", key, "evil.yaml")
    (folder / "evil.yaml").write_text(f"class_path: {EVIL}\n")
    assert main(["test", str(folder)]) != 0
    assert EVIL in capsys.readouterr().err


def test_shipped_parts_and_those_of_torch_and_lightning_are_known():
    known = ["nmpm.processors.UNet", "nmpm.processors.unet.UNet", "torch.optim.Adam", "nmpm.optimizers.SOAP"]
    known += ["lightning.pytorch.callbacks.EarlyStopping", "lightning.pytorch.loggers.CSVLogger"]
    for name in known:
        assert foreign_names({"model": {"part": {"class_path": name}}}) == []
    texts = {"path": "/data/a.b", "precision": "bf16-mixed", "monitor": "valid/overall", "filename": "goop.yaml"}
    assert foreign_names({"data": texts}) == []


def test_a_run_with_parts_of_others_is_tested_when_that_is_asked_for(make_dataset, tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "from lightning.pytorch.callbacks import Callback\n\n\nclass Mine(Callback):\n"
        "    def on_test_start(self, *_):\n        open('ran', 'w').close()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    data = source("waterdrop.yaml", make_dataset)
    assert (
        main(["fit", *WATERDROP, *data, "--trainer.default_root_dir", "run", "--trainer.callbacks", "mine.Mine"]) == 0
    )
    Path("ran").unlink()
    assert main(["test", "run"]) == 1
    assert "run/config.yaml names mine.Mine" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert main(["test", "run", "--trust-config"]) == 0
    assert Path("ran").exists()
