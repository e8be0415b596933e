"""What a command does not need it does not import: torch takes a second, Lightning three."""

import dataclasses
import inspect
import subprocess
import sys
from importlib import import_module

import pytest

from nmpm import EmulatorModule, EmulatorRecipe, TrajectoryDataModule
from nmpm.cli.early_checks import PARTS, argument_names, class_names


@pytest.mark.parametrize(
    ("words", "unwanted"),
    [
        (["rollout", "goop", "--frames", "8", "--out", "out.h5"], {"lightning", "neuralop", "matplotlib"}),
        (["simulate", "--list"], {"lightning", "torch", "matplotlib"}),
        (["zoo", "card", "goop"], {"lightning", "matplotlib"}),
        (["--version"], {"lightning", "torch", "numpy"}),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_command_leaves_alone_what_it_does_not_need(words, unwanted, tmp_path):
    script = (
        f"import sys; from nmpm.cli import main; assert main({words!r}) == 0; "
        f"print('imported', sorted({unwanted!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.splitlines()[-1] == "imported []"


GOOP, TRAINING = ["fit", "--config", "goop.yaml"], ("fit", "validate", "test", "predict")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--model.cels", "3"], "did you mean --model.cells?"),
        (["--model.cels=3"], "did you mean --model.cells?"),
        (["--config", "mine.yaml"], "unknown key model.cels; did you mean model.cells?"),
        (["--model.processor=nmpm.processors.Unet"], "did you mean nmpm.processors.UNet?"),
        (["--data.path", "nowhere"], "--data.path nowhere: there is no such dataset."),
        (["--data.name", "lava"], "No embedded dataset is called 'lava'"),
        (["--ckpt_path=nowhere.ckpt"], "--ckpt_path nowhere.ckpt: there is no such checkpoint."),
        (["test", "nowhere"], "nmpm test: nowhere: there is no such folder."),
        (["predict", "mine.yaml"], "mine.yaml is a file: name the folder of a run"),
        (["validate", "."], ". is not the folder of a run: there is no config.yaml in it."),
        (
            ["test", "run"],
            "no run/checkpoints/best.ckpt or run/checkpoints/last.ckpt; checkpoints there: none.",
        ),
        (["fit", "--resume=run"], "run: there is no run/checkpoints/last.ckpt; checkpoints there: none."),
        (["fit", "--resume"], "--resume lacks the folder of a run"),
        (["fit", "run"], "to go on with a run, call nmpm fit --resume run."),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_common_mistakes_are_found_before_torch_and_lightning_are_imported(words, complaint, tmp_path):
    (tmp_path / "mine.yaml").write_text("model: {cels: 3}\n")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("model: {cells: 3}\n")
    words = words if words[0] in TRAINING else [*GOOP, *words]
    script = (
        f"import sys; from nmpm.cli import main; assert main({words!r}); "
        "print('imported', sorted({'torch', 'lightning'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "imported []\n"
    assert complaint in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_names_that_are_checked_early_are_those_of_the_parts():
    own = set(inspect.signature(EmulatorModule).parameters) - {"recipe"}
    fields = {field.name for field in dataclasses.fields(EmulatorRecipe)}
    assert argument_names("model") == own | fields
    assert argument_names("data") == set(inspect.signature(TrajectoryDataModule).parameters)
    for module in PARTS:
        public = {name for name, kind in vars(import_module(module)).items() if isinstance(kind, type)}
        defined = {name for name in public if vars(import_module(module))[name].__module__.startswith("nmpm.")}
        assert defined <= class_names(module), module


def test_simulators_and_numba_are_imported_for_simulated_data_alone():
    script = "import sys; import nmpm.cli.run_training; print(sorted({'numba', 'nmpm.sim'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
