"""Snippets of the README and of the documentation: Python runs, commands and their options exist, data are valid."""

import contextlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from nmpm import Zoo
from nmpm._support.shipped import find_config
from nmpm.cli import main

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
SMALLER = {
    "max_steps=500": "max_steps=2",
    "val_check_interval=250": "val_check_interval=2",
    "frames=400": "frames=24",
    "frames=100": "frames=8",
    "max_ms_per_frame=5.0": "max_ms_per_frame=1000.0",  # whatever else the machine does
    "range(50)": "range(3)",
    "range(20)": "range(3)",
}
LAUNCHERS = ("srun", "torchrun")
RECORDED = ("DATA", "FOLDER", "channel", "goop2", "goop-as-in-the-paper")
TRAINING = ("fit", "validate", "test", "predict")


@dataclass(frozen=True)
class Block:
    """A fenced block of a document."""

    document: Path
    language: str
    text: str

    @property
    def file(self) -> str:
        """Name of the file that a block of Python is to be saved as, "" for none."""
        named = re.match(r"# (\w+\.py)\n", self.text)
        return named[1] if named else ""

    def __str__(self) -> str:
        first = self.text.partition("\n")[0]
        return f"{self.document.stem}: {first}"


def blocks(*languages: str) -> list[Block]:
    fenced = re.compile(r"^```(\w+)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
    found = [Block(document, *match) for document in DOCUMENTS for match in fenced.findall(document.read_text("utf-8"))]
    return [block for block in found if not languages or block.language in languages]


def lines() -> list[list[str]]:
    """All shell commands, without comments and substitutions."""
    joined = "\n".join(block.text for block in blocks("bash")).replace("\\\n", " ")
    return [shlex.split(re.sub(r"\$\(.*\)", "", line), comments=True) for line in joined.splitlines()]


def commands() -> list[list[str]]:
    """The `nmpm` commands, those of launchers too, each once."""
    ours = [words[words.index("nmpm") :] for words in lines() if words and words[0] in ("nmpm", *LAUNCHERS)]
    return [list(words) for words in dict.fromkeys(map(tuple, ours))]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A working directory with the files that snippets are to be saved as; they can be imported."""
    files = [block for block in blocks("python") if block.file]
    for block in files:
        (tmp_path / block.file).write_text(block.text, "utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for block in files:
        sys.modules.pop(block.file.removesuffix(".py"), None)


@pytest.mark.parametrize("block", blocks("python"), ids=str)
def test_python(block, make_dataset, workplace, monkeypatch):
    volume = Zoo.load("goop").scene.particle_volume
    make_dataset(train=((40, 6), (40, 7)), particle_volume=volume).rename(workplace / "goop2")
    code = block.text
    for long, short in SMALLER.items():
        code = code.replace(long, short)
    names = {"__name__": "snippet", "__file__": block.file}
    monkeypatch.setitem(sys.modules, "snippet", ModuleType("snippet"))  # where dataclasses look types up
    exec(compile(code, block.document.name, "exec"), names)
    run_tests(names)


def run_tests(names: dict) -> None:
    """Runs the tests of the test classes that a snippet defines."""
    for kind in [value for name, value in names.items() if name.startswith("Test")]:
        for name in [name for name in dir(kind) if name.startswith("test_")]:
            getattr(kind(), name)()


def test_there_is_something_to_test():
    assert len(blocks("python")) >= 10
    shown = {words[1] for words in commands()}
    assert shown >= {
        "fit",
        "test",
        "zoo",
        "rollout",
        "render",
        "view",
        "stress",
        "trade",
        "compare",
        "inspect",
        "init",
        "convert",
        "export",
    }
    assert {block.language for block in blocks()} <= {"python", "bash", "yaml", "toml", "math", "text"}


@pytest.mark.parametrize("words", [w for w in commands() if w[1] not in TRAINING], ids=" ".join)
def test_options_of_commands_exist(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as exit_:
        main([*words[1 : 3 if words[1] == "zoo" else 2], "--help"])
    assert exit_.value.code == 0
    known = set(re.findall(r"--[\w-]+", capsys.readouterr().out))
    assert {word.split("=")[0] for word in words if word.startswith("--")} <= known


@pytest.mark.parametrize("words", [w for w in commands() if w[1] in TRAINING], ids=" ".join)
def test_configurations_of_trainings_are_valid(words, make_dataset, workplace, capsys):
    make_dataset().rename(workplace / "honey")
    run = workplace / "runs" / "goop"
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.yaml").write_text(find_config("goop.yaml").read_text("utf-8"), "utf-8")
    for name in ("best.ckpt", "last.ckpt"):
        (run / "checkpoints" / name).touch()
    for word in {"FOLDER.yaml", "honey.yaml"} & set(words):  # that nmpm init wrote
        Path(word).write_text(find_config("waterdrop.yaml").read_text("utf-8").replace("???", "honey"), "utf-8")
    given = [str(workplace / "honey") if word in RECORDED else word for word in words[1:]]
    with contextlib.suppress(SystemExit):
        main([*given, *([] if "--print_config" in given else ["--print_config"])])
    assert "processor:" in capsys.readouterr().out


@pytest.mark.parametrize("words", [w for w in lines() if w and w[0] == "python"], ids=" ".join)
def test_scripts_and_their_options_exist(words):
    text = (ROOT / words[1]).read_text("utf-8")
    if "make_timing_parser" in text:
        text += (ROOT / "benchmarks/timing.py").read_text("utf-8")
    assert all(f'"{word}"' in text for word in words if word.startswith("--"))
    arguments = text.split("add_argument(")[1:]
    required = [re.findall(r'"(--[\w-]+)"', argument)[0] for argument in arguments if "required=True" in argument]
    assert set(required) <= set(words)


@pytest.mark.parametrize("block", blocks("yaml"), ids=str)
def test_pieces_of_configurations_are_valid(block, workplace, capsys):
    Path("piece.yaml").write_text(block.text, "utf-8")
    with contextlib.suppress(SystemExit):
        main(["fit", "--config", "goop.yaml", "--config", "piece.yaml", "--print_config"])
    printed = yaml.safe_load(capsys.readouterr().out)
    for section, values in yaml.safe_load(block.text).items():
        for name, value in values.items():
            assert printed[section][name].items() >= value.items()


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_pieces_of_toml_are_valid(block):
    assert tomllib.loads(block.text)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize("block", blocks("bash"), ids=str)
def test_shell_snippets_can_be_parsed(block):
    run = subprocess.run(["bash", "-n"], input=block.text, text=True, capture_output=True, timeout=60, check=False)
    assert run.returncode == 0, run.stderr
