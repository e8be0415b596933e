from types import SimpleNamespace

import pytest

from nmpm.cli import main
from nmpm.cli.trade import _models
from nmpm.evaluation.trade import default_sweep_text
from nmpm.zoo import load_model
from tests.evaluation.trade.made_up import SWEEP, tiny_scenes


def test_the_shipped_sweep_is_printed(capsys):
    assert main(["trade", "--print_config"]) == 0
    assert capsys.readouterr().out == default_sweep_text()


def test_help_teaches(capsys):
    with pytest.raises(SystemExit):
        main(["trade", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    for word in ("runs/a", "--print_config", "goes on after an interruption", "trade.html"):
        assert word in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trade"], "name a dataset"),
        (["trade", "nothing"], "nothing is neither a folder nor an embedded dataset: dambreak2d"),
        (["trade", "goop", "--scenes", "0"], "--scenes 0: it must be at least 1"),
        (["trade", "goop", "--config", "nothing.yaml"], "there is no such file"),
        (["trade", "goop", "--device", "abacus"], "--device abacus"),
    ],
)
def test_mistakes_are_named(words, message, capsys):
    assert main(words) == 1
    assert message in capsys.readouterr().err


def test_models_are_those_of_the_dataset_and_damaged_ones_are_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path))
    for name in ("bad", "other", "broken"):
        (tmp_path / "zoo" / name).mkdir(parents=True)
    (tmp_path / "zoo" / "bad" / "card.yaml").write_text("format: 1\ndataset: goop, simulated by nmpm")
    (tmp_path / "zoo" / "other" / "card.yaml").write_text("format: 1\ndataset: recorded")
    (tmp_path / "zoo" / "broken" / "card.yaml").write_text("{")
    loaded = []
    monkeypatch.setattr("nmpm.zoo.load_model", lambda name: loaded.append(name) or load_model(name))
    assert sorted(_models(None, SimpleNamespace(name="goop"))) == ["goop", "goop/fast"]
    assert sorted(loaded) == ["bad", "goop", "goop/fast"]
    left_out = capsys.readouterr().err.splitlines()
    assert [line.partition(": ")[0] for line in left_out] == ["left out", "left out"]
    assert "bad/model.safetensors" in left_out[0]
    assert "broken/card.yaml" in left_out[1]


def test_a_folder_is_measured_and_the_report_written(tmp_path, capsys):
    tiny_scenes(tmp_path / "tiny")
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    words = ["trade", str(tmp_path / "tiny"), "--models", "--config", str(tmp_path / "sweep.yaml")]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr()
    assert "the Pareto set in time and MSE of the full rollout" in shown.out
    assert "it made these data" in shown.out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"points", "trade.csv", "trade.png", "trade.html"}
