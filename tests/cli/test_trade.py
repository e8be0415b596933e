import json
import re
import shlex

from nmpm.cli import main
from nmpm.data.sources import FolderSource
from nmpm.evaluation.trade import read_scenes, shipped_sweep_text
from nmpm.zoo import Pretrained, load_model
from nmpm.zoo.registry import load_models_of
from tests.evaluation.trade.made_up import SWEEP, tiny_emulator, tiny_scenes


def test_the_shipped_sweep_is_printed(capsys):
    assert main(["trade", "--print_config"]) == 0
    assert capsys.readouterr().out == shipped_sweep_text("trade")


def test_models_are_those_of_the_dataset_and_damaged_ones_are_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NMPM_HOME", str(tmp_path))
    for name in ("bad", "other", "broken"):
        (tmp_path / "zoo" / name).mkdir(parents=True)
    (tmp_path / "zoo" / "bad" / "card.yaml").write_text("format: 1\ndataset: goop, simulated by nmpm")
    (tmp_path / "zoo" / "other" / "card.yaml").write_text("format: 1\ndataset: recorded")
    (tmp_path / "zoo" / "broken" / "card.yaml").write_text("{")
    loaded = []
    monkeypatch.setattr("nmpm.zoo.registry.load_model", lambda name: loaded.append(name) or load_model(name))
    models, left_out = load_models_of("goop")
    assert sorted(models) == ["goop", "goop/fast"]
    assert sorted(loaded) == ["bad", "goop", "goop/fast"]
    monkeypatch.setattr("nmpm.evaluation.trade.find_scenes", lambda *_: tiny_scenes(tmp_path / "tiny"))
    assert main(["trade", "goop", "--materials", "mud=clay", "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == [f"left out: {error}" for error in left_out]
    for line, file in zip(said, ("bad/model.safetensors", "broken/card.yaml", "no model has clay"), strict=True):
        assert file in line


def test_a_folder_is_measured_with_a_predictor_of_another_package_and_the_report_written(tmp_path, capsys):
    tiny_scenes(tmp_path / "tiny")
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    words = ["trade", str(tmp_path / "tiny"), "--models", "--config", str(tmp_path / "sweep.yaml")]
    words += ["--predictors", "tests.evaluation.trade.made_up:Shifted:0.25"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "tiny: 2 test scenes" in shown
    assert "shifted by 0.25: unstable in 2 scenes" in shown
    assert "it made these data" in shown
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"points", "trade.csv", "trade.json", "trade.md", "trade.png", "errors.png", "frames.png"}


def test_models_are_compared(tmp_path, capsys, monkeypatch):
    scenes = tiny_scenes(tmp_path / "tiny")
    model = Pretrained(tiny_emulator(scenes.scene), {})
    monkeypatch.setattr("nmpm.zoo.registry.load_model", lambda _: model)
    words = ["compare", "goop", "--data", str(tmp_path / "tiny"), "--out", str(tmp_path / "out")]
    monkeypatch.setattr("nmpm.evaluation.trade.shipped_sweep_text", lambda _: SWEEP)
    assert main(words) == 0
    out = capsys.readouterr().out
    for name in ("goop", "nothing moves", "free fall", "twin: 3 of 6"):
        assert name in out
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"points", "compare.csv", "compare.json", "errors.png", "frames.png"} < written


def test_ensembles_stand_beside_one_rollout_in_time_and_crps(tmp_path, capsys, monkeypatch):
    scenes = tiny_scenes(tmp_path / "tiny")
    model = Pretrained(tiny_emulator(scenes.scene), {"ensemble": {"nudge": 0.3}})
    monkeypatch.setattr("nmpm.zoo.registry.load_model", lambda _: model)
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    words = ["trade", str(tmp_path / "tiny"), "--models", "goop", "--config", str(tmp_path / "sweep.yaml")]
    assert main([*words, "--members", "3", "--out", str(tmp_path / "out")]) == 0
    assert "CRPS ×10⁻³: fair" in " ".join(capsys.readouterr().out.split())
    choices = {one["name"]: one for one in json.loads((tmp_path / "out" / "trade.json").read_text())["predictors"]}
    ensemble, single = choices["goop, 3 members"], choices["goop"]
    assert ensemble["settings"]["nudge"] == 0.3  # the card's
    assert 0 < ensemble["errors"]["crps"]["mean"] != single["errors"]["crps"]["mean"] > 0
    assert ensemble["ms_per_frame"]["median"] > single["ms_per_frame"]["median"]


def record(folder, name):
    """Tiny scenes without their simulator, as recorded ones are."""
    tiny_scenes(folder / name)
    path = folder / name / "metadata.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in content.items() if key != "simulation"}))
    return folder / name


def test_of_recordings_errors_come_first_then_how_long_the_rest_takes(tmp_path, capsys, monkeypatch):
    data, out = record(tmp_path, "my data"), tmp_path / "out"
    model = Pretrained(tiny_emulator(read_scenes("recorded", FolderSource(data), 2).scene), {})
    monkeypatch.setattr("nmpm.zoo.registry.load_model", lambda _: model)
    monkeypatch.setattr("nmpm.evaluation.trade.shipped_sweep_text", lambda _: SWEEP)
    words = ["trade", str(data), "--models", "goop", "--out", str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    table, rest = said.split("next: ")
    assert "goop" in table
    assert " ms " not in table
    assert re.match(r"times, and the models in other forms: 8 measurements, about 0:00:\d\d\n", rest)
    assert {path.name for path in out.iterdir()} == {
        "points", "trade.csv", "trade.json", "trade.md", "errors.png", "frames.png",
    }  # fmt: skip
    command = shlex.split(rest.splitlines()[1])
    assert command == ["nmpm", *words, "--times"]
    assert main(command[1:]) == 0
    assert " ms " in capsys.readouterr().out
    assert (out / "trade.png").is_file()
    assert main(words) == 0
    said = capsys.readouterr().out
    assert " ms " in said
    assert "next: " not in said


def test_an_interrupted_trade_keeps_what_is_measured(tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    data, out = record(tmp_path, "recorded"), tmp_path / "out"
    monkeypatch.setattr("nmpm.evaluation.comparison.free_fall", interrupt)
    monkeypatch.setattr("nmpm.evaluation.trade.sweep.free_fall", interrupt)
    assert main(["trade", str(data), "--models", "--out", str(out)]) == 130
    assert f"interrupted; what is measured is in {out}, and the same command goes on." in capsys.readouterr().err
    (stored,) = (out / "points").iterdir()
    assert len(json.loads(stored.read_text())["values"]) == 2
