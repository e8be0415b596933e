"""The package of docs/howto/plugin.md, installed as pip does: all commands see its parts."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

import numpy as np
import pytest

from nmpm._support.shipped import PACKAGE


@pytest.fixture(scope="module")
def nmpm(tmp_path_factory):
    """Runs a command beside the installed package, in a folder with frames in its format; gives status and output."""
    text = (PACKAGE.parent / "docs" / "howto" / "plugin.md").read_text("utf-8")
    project = re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1]
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    plain = tomllib.loads(project)["project"]
    site, work = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("work")
    (site / "nmpm_points.py").write_text(code, "utf-8")
    goop = (PACKAGE / "sim" / "presets" / "goop.yaml").read_text("utf-8")
    (site / "splash.yaml").write_text(
        goop.replace("name: goop", "name: splash").replace("frames: 400", "frames: 8"), "utf-8"
    )
    information = site / f"nmpm_points-{plain['version']}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {plain['name']}\nVersion: {plain['version']}\n"
    )
    groups = "".join(
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in parts.items())
        for group, parts in plain["entry-points"].items()
    )
    (information / "entry_points.txt").write_text(groups)
    frames = work / "run"
    frames.mkdir()
    start = np.random.default_rng(0).uniform(0.2, 0.8, (50, 3))
    for frame in range(20):
        (start - [0, 0.5e-3 * frame**2, 0]).astype(np.float32).tofile(frames / f"{frame:03}.f4")
    paths = os.pathsep.join([str(site), str(PACKAGE.parent)])
    variables = os.environ | {"PYTHONPATH": paths, "NMPM_HOME": str(work / "home"), "COLUMNS": "200"}

    def run(*words: str) -> tuple[int, str]:
        script = "import sys; from nmpm.cli import main; sys.exit(main())"
        ran = subprocess.run(
            [sys.executable, "-c", script, *words], cwd=work, env=variables, capture_output=True, text=True, check=False
        )
        return ran.returncode, ran.stdout + ran.stderr

    return run


def test_a_reader_reads_in_every_command(nmpm):
    assert "a .f4 file for each frame" in nmpm("convert", "--help")[1]
    status, text = nmpm("inspect", "run", "--dt", "0.01")
    assert status == 0
    assert "50" in text
    assert nmpm("convert", "run", "out.csv", "--dt", "0.01")[0] == 0


def test_unknown_formats_name_it(nmpm):
    status, text = nmpm("convert", "run", "new", "--format", "pointss")
    assert status == 1
    assert "Did you mean points?" in text


def test_a_writer_writes_a_rollout(nmpm):
    status, text = nmpm("rollout", "waterramps", "--frames", "8", "--out", "last.f4")
    assert status == 0
    assert "open last.f4 in whatever reads float32" in text
    assert ".f4" in nmpm("rollout", "--help")[1]
    status, weight = nmpm("weigh", "last.f4", "--density", "1")
    assert status == 0
    assert float(weight) > 100


def test_a_scene_is_simulated_and_suggested(nmpm):
    assert "splash" in nmpm("simulate", "--list")[1]
    assert nmpm("simulate", "splash", "--train", "1", "--valid", "0", "--test", "0")[0] == 0
    status, text = nmpm("inspect", "splash")
    assert (status, "9 frames" in text) == (0, True), text
    for words in (("simulate", "splush"), ("fit", "--data.name", "splush")):
        status, text = nmpm(*words)
        assert status == 1
        assert "Did you mean splash?" in text


def test_a_command_has_help_and_checks(nmpm):
    assert "Print the mass of the particles of a file." in nmpm("--help")[1]
    status, text = nmpm("weigh", "--help")
    assert status == 0
    assert "In kg per length³ (default: 1000.0)" in text
    assert nmpm("weight")[1].startswith("nmpm: there is no command 'weight'; did you mean weigh?")
    assert nmpm("weigh", "run/000.f4", "--densty", "2")[0] == 2
    assert nmpm("weigh", "run/000.f4")[1] == "50000\n"


def test_a_group_of_stress_tests_runs(nmpm):
    assert "drop" in nmpm("stress", "--help")[1]
    status, text = nmpm("stress", "goop", "--groups", "drop")
    assert (status, "1 passed, 0 failed." in text) == (0, True), text


def test_a_loss_and_a_metric_train_and_are_read_back(nmpm):
    counts = ("--data.generate.counts", "{train: 1, valid: 0, test: 1}", "--trainer.limit_val_batches", "0")
    parts = ("--model.loss", "nmpm_points.Doubled", "--model.metrics+", "nmpm_points.First")
    small = ("--model.cells", "16", "--model.frames", "2", "--model.processor.width", "4")
    short = ("--trainer.max_steps", "1", "--trainer.default_root_dir", "trained")
    status, text = nmpm("fit", "--data.name", "splash", *counts, *parts, *small, *short)
    assert (status, "mse@1" in text) == (0, True), text
    status, text = nmpm("test", "trained", "--trust-config")
    assert (status, "mse@1" in text) == (0, True), text
