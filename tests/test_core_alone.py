"""The package with its core dependencies alone, in an environment that has nothing else."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from nmpm._support.shipped import PACKAGE

PROJECT = PACKAGE.parent


def installed(requirements: list[str]) -> set[str]:
    """Names of the installed distributions that these need, and those that they need, and so on."""
    todo, extras = [Requirement(text) for text in requirements], dict[str, set[str]]()
    while todo:
        requirement = todo.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in extras and requirement.extras <= extras[name]:
            continue
        extras.setdefault(name, set()).update(requirement.extras)
        try:
            needed = map(Requirement, distribution(name).requires or ())
        except PackageNotFoundError:  # of another platform
            continue
        todo += [
            each
            for each in needed
            if not each.marker or any(each.marker.evaluate({"extra": extra}) for extra in {"", *extras[name]})
        ]
    return set(extras)


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory):
    """Runs Python in an environment of links to the core's dependencies; returns what it prints."""
    folder = tmp_path_factory.mktemp("core")
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    for name in installed(project["dependencies"]):
        try:
            files = distribution(name).files or ()
        except PackageNotFoundError:
            continue
        for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
            source = Path(str(distribution(name).locate_file(top)))
            if source.exists() and not (folder / top).exists():
                (folder / top).symlink_to(source)
    home = tmp_path_factory.mktemp("home")
    variables = {"PYTHONPATH": f"{folder}{os.pathsep}{PROJECT}", "NMPM_HOME": str(home), "PYTHONNOUSERSITE": "1"}

    def run(script: str) -> str:
        words = [sys.executable, "-S", "-c", script]  # -S: without the packages of this environment
        ran = subprocess.run(words, env=os.environ | variables, cwd=home, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    return run


def test_extras_are_not_there(core):
    modules = [
        "ot",
        "tensorboard",
        "imageio",
        "pyvista",
        "onnx",
        "openvino",
        "websockets",
        "pyarrow",
        "gsd",
        "nbclient",
    ]
    script = f"from importlib.util import find_spec\nprint([name for name in {modules} if find_spec(name)])"
    assert core(script) == "[]\n"


def test_a_model_rolls_out(core):
    script = """
from nmpm import Zoo
model = Zoo.load("waterramps")
print(bool(model.rollout(model.example(count=100), 16).isfinite().all()))
"""
    assert core(script) == "True\n"


def test_what_an_extra_is_for_says_so_in_one_line(core):
    script = """
from nmpm.errors import ConfigError
from nmpm.evaluation.prediction_errors import Measures
from nmpm.metrics import EarthMover
for kind in (Measures, EarthMover):
    try:
        kind()
    except ConfigError as error:
        print(error)
print(Measures(emd_frames=0).emd_frames)
"""
    line = (
        'The earth mover\'s distance needs ot, which is not installed: pip install -e ".[emd]" in the clone of nmpm.\n'
    )
    assert core(script) == 2 * line + "0\n"


def test_a_training_ends_with_table_and_pictures(core):
    script = """
from pathlib import Path
from nmpm.cli import main
words = "fit --config goop.yaml --trainer.max_steps 2 --trainer.val_check_interval 2 --data.batch_size 2"
tiny = "--trainer.accelerator cpu --trainer.enable_progress_bar false --model.unroll 1 --data.generate"
counts = '{"counts": {"train": 2, "valid": 1, "test": 1}, "frames": 40}'
status = main([*words.split(), *tiny.split(), counts])
print(status, {".gif", ".png"} <= {path.suffix for path in Path("runs/goop").iterdir()})
"""
    assert core(script).endswith("\n0 True\n")
