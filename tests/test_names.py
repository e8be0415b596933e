"""Names in messages, docstrings and examples of the package: Python names, options and commands that exist."""

import ast
import inspect
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import fields
from importlib import import_module
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from nmpm._support.shipped import PACKAGE
from nmpm.cli import COMMANDS
from nmpm.cli.command import Command, label
from nmpm.cli.training_options import known_options


def commands(kinds: Iterable[Any]) -> Iterator[type[Command]]:
    """Commands that are dataclasses of options, and those within groups."""
    for kind in kinds:
        if isinstance(kind, type):
            yield kind
            yield from commands(getattr(kind, "commands", {}).values())


TREES = {
    str(path.relative_to(PACKAGE)): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(PACKAGE.rglob("*.py"))
}
SAVER = set(inspect.signature(ModelCheckpoint).parameters)
SECTIONS = {
    "model": set(known_options()["model"]),
    "data": set(known_options()["data"]),
    "trainer": set(inspect.signature(Trainer).parameters),
    "checkpoint": SAVER,
    "resume": SAVER,
}
LIGHTNING = {
    "help",
    "help_all",
    "version",
    "verbose",
    "weights_only",
}
OPTIONS = {f"--{name}" for name in (*LIGHTNING, *SECTIONS)} | {
    word.value
    for tree in TREES.values()
    for node in ast.walk(tree)
    if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"
    for word in node.args
    if isinstance(word, ast.Constant)
} | {label(field) for kind in commands(COMMANDS.values()) for field in fields(kind)}  # fmt: skip
OTHER_PROGRAMS = re.compile(
    r"pip install[^:;({]*|`hf [^`]*`|--include \{}"
    r"|nmpm\.(?:plugins|readers|writers|scenes|commands|stress|engines|runtimes)\b"
)

EXTRAS = {"install": 0, "require": 1}
"""Functions that name an extra, and the position of its argument."""


def texts(tree: ast.Module) -> Iterator[str]:
    """The strings of a file, with {} for what is filled in."""
    filled = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    parts = {part for node in filled for part in node.values}
    for node in filled:
        yield "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in parts:
            yield node.value


def is_importable(name: str) -> bool:
    found, path = import_module("nmpm"), "nmpm"
    for word in name.split(".")[1:]:
        path += f".{word}"
        try:
            found = getattr(found, word) if hasattr(found, word) else import_module(path)
        except ImportError:
            return False
    return True


def is_option(name: str) -> bool:
    section, _, rest = name.removeprefix("--").partition(".")
    return rest.partition(".")[0] in SECTIONS.get(section, ()) if rest else name in OPTIONS


def wrong_names(text: str) -> Iterator[str]:
    text = OTHER_PROGRAMS.sub("", text)
    yield from (name for name in re.findall(r"\bnmpm(?:\.[A-Za-z_]\w*)+(?![\w{])", text) if not is_importable(name))
    yield from (
        name for name in re.findall(r"(?<![\w-])--[a-z](?:[a-z0-9_.-]*[a-z0-9_])?", text) if not is_option(name)
    )
    commands = re.findall(r"(?:`|^ *|: )nmpm ([a-z]+)", text, re.MULTILINE)
    yield from (f"nmpm {name}" for name in commands if name not in COMMANDS)


def test_names_in_strings_exist():
    assert not [(file, name) for file, tree in TREES.items() for text in texts(tree) for name in wrong_names(text)]


def test_extras_that_messages_name_exist():
    """No index has nmpm: extras are installed from a clone."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    commands = [
        command
        for tree in TREES.values()
        for text in texts(tree)
        for command in re.findall(r"pip install[^:;(]*", text)
    ]
    written = {extra for command in commands for extra in re.findall(r"\"\.\[(\w+)\]\"", command)}
    called = {
        node.args[position].value
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and (position := EXTRAS.get(getattr(node.func, "id", ""))) is not None
        and isinstance(node.args[position], ast.Constant)
    }
    assert called
    assert written | called <= set(project["optional-dependencies"])
    assert not [command for command in commands if "nmpm[" in command]


def test_wrong_names_are_noticed():
    text = "`nmpm fitt --data.pat x`: nmpm.Constraints(solids=False) or --sheds"
    assert list(wrong_names(text)) == ["nmpm.Constraints", "--data.pat", "--sheds", "nmpm fitt"]
