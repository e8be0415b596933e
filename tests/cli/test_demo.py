import re
import webbrowser
from pathlib import Path

import numpy as np
import pytest

from nmpm import Zoo
from nmpm.cli import main
from nmpm.data.format import Split
from nmpm.sim import load_preset
from nmpm.viz.files import read_labelled


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NMPM_HOME", str(tmp_path / "home"))


def test_a_scene_is_simulated_and_emulated_and_opened(monkeypatch, capsys):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    assert main(["demo", "goop/fast", "--seed", "1", "--frames", "20"]) == 0
    said = capsys.readouterr().out
    assert "Scene of goop, seed 1" in said
    times = [float(value) for value in re.findall(r"([\d.e+]+) ms per frame", said)]
    assert len(times) == 4  # of the shipped setting, of two with fewer substeps, and of the emulator
    assert min(times) > 0
    assert len(re.findall("CPU time", said)) == 4
    faster = float(re.search(r"([\d.]+) times as fast at equal error", said)[1])
    named = re.search(r"no less accurate \((.+?)\)", said)[1]
    row = re.search(rf"([\d.]+) ms per frame, CPU time on .*: {named}\n", said)
    assert faster == pytest.approx(float(row[1]) / times[-1], rel=0.02)
    errors = re.search(r"emulator((?: +[\d.e+-]+)+)\n +nothing moves((?: +[\d.e+-]+)+)", said)
    emulator, still = (np.array(row.split(), dtype=float) for row in errors.groups())
    assert len(emulator) == len(still) == 3  # at frames 1, 10 and 20
    assert (emulator < still).all()
    assert opened == [Path("fast-demo.html").absolute().as_uri()]
    preset = load_preset("goop")
    truth = preset.simulate_from(preset.draw(1), 21).position
    shown = read_labelled(Split(Path("fast-demo.h5")))
    assert list(shown.positions) == ["truth", "prediction"]
    np.testing.assert_allclose(shown.positions["truth"], truth)
    expected = Zoo.load("goop/fast").rollout(Zoo.load("goop/fast").example(seed=1), 20)[0]
    np.testing.assert_allclose(shown.positions["prediction"][2:], expected, atol=1e-6)


def test_a_page_is_not_opened_unasked_or_without_a_display(monkeypatch, capsys):
    monkeypatch.setattr(webbrowser, "open", lambda _: pytest.fail("opened"))
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["demo", "goop", "--frames", "2", "--out", "a"]) == 0
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["demo", "goop", "--frames", "2", "--out", "b", "--no-open"]) == 0
    assert capsys.readouterr().out.count("open it in a browser") == 2
    assert Path("a.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["waterdrop"], "waterdrop was not trained on scenes of a shipped simulator"),
        (["goop", "--frames", "0"], "--frames 0: it must be at least 1"),
        (["goop", "--out", "none/there"], "--out none/there.h5"),
        (["gop"], "Did you mean goop"),
    ],
)
def test_a_demonstration_that_cannot_be_is_refused(words, message, capsys):
    assert main(["demo", *words]) == 1
    assert message in capsys.readouterr().err
