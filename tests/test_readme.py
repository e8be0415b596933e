"""The README's snippets: the Python ones run, the commands and their options exist."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest

from nmpm import Zoo
from nmpm.cli import main

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
SMALLER = {"max_steps=500": "max_steps=2", "val_check_interval=250": "val_check_interval=2", "frames=400": "frames=24"}
OURS = re.compile(r"nmpm (\w+)")
TRAINING = ("fit", "validate", "test", "predict")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def commands() -> list[list[str]]:
    """The README's `nmpm` commands, comments and shell variables left out."""
    lines = "\n".join(blocks("bash")).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.startswith("nmpm ")]


@pytest.mark.parametrize("code", blocks("python"), ids=lambda code: code.split("\n")[0])
def test_python(code, make_dataset, tmp_path, monkeypatch):
    volume = Zoo.load("goop").scene.particle_volume
    make_dataset(train=((40, 6), (40, 7)), particle_volume=volume).rename(tmp_path / "goop2")
    monkeypatch.chdir(tmp_path)
    for long, short in SMALLER.items():
        code = code.replace(long, short)
    exec(compile(code, "README.md", "exec"), {})


def test_there_is_something_to_test():
    assert len(blocks("python")) >= 5
    assert {words[1] for words in commands()} >= {"fit", "zoo", "rollout", "render", "stress", "inspect", "export"}


@pytest.mark.parametrize("words", [w for w in commands() if w[1] not in TRAINING], ids=" ".join)
def test_options_of_commands_exist(words, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([words[1], "--help"])
    assert exit_.value.code == 0
    known = set(re.findall(r"--[\w-]+", capsys.readouterr().out))
    nested = {"zoo": {"--about", "--full", "--data"}}.get(words[1], set())
    assert {word.split("=")[0] for word in words if word.startswith("--")} <= known | nested


@pytest.mark.parametrize("words", [w for w in commands() if w[1] in TRAINING], ids=" ".join)
def test_configurations_of_trainings_are_valid(words, make_dataset, tmp_path, monkeypatch, capsys):
    folder = make_dataset()
    folder.rename(tmp_path / "honey")
    monkeypatch.chdir(tmp_path)
    given = [str(tmp_path / "honey") if word == "FOLDER" else word for word in words[1:]]
    with contextlib.suppress(SystemExit):
        main([*given, *([] if "--print_config" in given else ["--print_config"])])
    assert "processor:" in capsys.readouterr().out
