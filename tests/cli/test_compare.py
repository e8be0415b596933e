import pytest

from nmpm.cli import main
from tests.evaluation.trade.made_up import tiny_emulator, tiny_scenes


def test_help_teaches(capsys):
    with pytest.raises(SystemExit):
        main(["compare", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    for word in ("--data waterdrop-xl", "--wider 2", "runs/mine", "frames.png", "measures only what is new"):
        assert word in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["goop", "--data", "nothing"], "nothing is neither a folder nor an embedded dataset: dambreak2d"),
        (["goop", "--data", "goop", "--scenes", "0"], "--scenes 0: it must be at least 1"),
        (["goop", "--data", "goop", "--wider", "1"], "--wider 1: it must be at least 2"),
        (["goop", "--data", "nothing", "--wider", "2"], "nothing cannot be widened"),
        (["nothing", "--data", "goop"], "The zoo holds no model 'nothing'"),
        (["goop", "--data", "goop", "--device", "abacus"], "--device abacus"),
    ],
)
def test_mistakes_are_named(words, message, capsys):
    assert main(["compare", *words]) == 1
    assert message in capsys.readouterr().err


def test_a_folder_is_measured_and_the_report_written(tmp_path, capsys, monkeypatch):
    scenes = tiny_scenes(tmp_path / "tiny")
    model = type("Loaded", (), {"emulator": tiny_emulator(scenes.scene)})
    monkeypatch.setattr("nmpm.zoo.load_model", lambda _: model)
    monkeypatch.setattr("nmpm.evaluation.compare.measure.MATCHED", 40)
    words = ["compare", "carried", "--data", str(tmp_path / "tiny"), "--out", str(tmp_path / "out")]
    assert main(words) == 0
    out = capsys.readouterr().out
    for name in ("tiny: 2 test scenes", "made the scenes", "carried", "nothing moves", "free fall"):
        assert name in out
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"points", "compare.json", "errors.png", "frames.png"}
