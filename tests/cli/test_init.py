import json
from pathlib import Path

import yaml

from nmpm.cli import main
from tests.cli.test_training_commands import TINY


def test_fit_without_a_configuration_writes_and_takes_that_of_init(make_dataset, capsys):
    folder = str(make_dataset(train=((40, 9),) * 2, valid=((40, 9),), test=((40, 9),)))
    assert main(["init", folder, "--out", "made.yaml"]) == 0
    assert "nmpm fit --config made.yaml" in capsys.readouterr().out
    fit = ["fit", "--data.path", folder, *TINY, "--trainer.default_root_dir", "run"]
    assert main(fit) == 0
    assert "No --config: wrote run/init.yaml" in capsys.readouterr().out
    assert json.loads(Path("run/report.json").read_text())["training"]["steps"] == 2  # options override
    one, other = (yaml.safe_load(Path(file).read_text()) for file in ("made.yaml", "run/init.yaml"))
    assert one["data"] == other["data"]
    assert main(fit) == 0
    said = capsys.readouterr().out
    assert "No --config: wrote run/version_1/init.yaml" in said
    assert "run holds a run; this is a new one.\nFiles: run/version_1. " in said
    assert json.loads(Path("run/version_1/report.json").read_text())["training"]["steps"] == 2
    assert sorted(path.name for path in Path("run").iterdir() if path.is_dir()) == ["checkpoints", "logs", "version_1"]


def test_a_configuration_states_obstacles_that_move_as_recorded(make_dataset):
    folder = str(make_dataset(train=((40, 9),), valid=(), test=(), statics=4))
    assert main(["init", folder, "--prescribed", "3", "--out", "made.yaml"]) == 0
    assert yaml.safe_load(Path("made.yaml").read_text())["data"]["prescribed"] == [3]
