"""Checks of a training command's names and paths that need neither torch nor Lightning, which take seconds to import.

They find the common mistakes early; whatever they pass is checked again, by the parser and by the parts themselves.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import read_yaml
from nmpm._support.shipped import PACKAGE
from nmpm.errors import ConfigError, DataError

NOT_FILES = (None, "last", "best", "null", "???")
"""Values of paths that name no file."""
SIGNATURES = {
    "model": (("training/module.py", "EmulatorModule"), ("emulator/recipe.py", "EmulatorRecipe")),
    "data": (("data/datamodule.py", "TrajectoryDataModule"),),
}
"""Files and classes whose arguments are the options --model.… and --data.…."""
PARTS = {
    "nmpm.processors": "processors/__init__.py",
    "nmpm.transfer": "transfer/__init__.py",
    "nmpm.decoders": "decoders.py",
    "nmpm.optimizers": "optimizers.py",
    "nmpm.metrics": "metrics/__init__.py",
}
"""Modules whose classes are named in configurations, and their files."""


class UsageError(Exception):
    """An option or key that does not exist, or a value of the wrong kind; the message is one line."""


def check_command(words: Sequence[str]) -> None:
    """Check the options of a training command, and the configuration files that it names.

    Args:
        words: With the paths of the configuration files.

    Raises:
        UsageError: for a misspelt name, or a configuration that is not YAML.
        ConfigError: if dataset or checkpoint do not exist.
        DataError: if there is no such embedded dataset.
    """
    configs = [read_config(Path(path)) for path in _config_paths(words)]
    _check_options(words, configs)
    _check_classes(words)
    options = dict(pairwise(words)) | dict(word.split("=", 1) for word in words if "=" in word)
    path = _value(options, configs, "data.path")
    _check_exists("--data.path", path, "dataset")
    _check_exists("--ckpt_path", _value(options, configs, "ckpt_path"), "checkpoint")
    if path in NOT_FILES and _value(options, configs, "data.source") in (None, "disk", "simulate"):
        _check_dataset(_value(options, configs, "data.name"))


def read_config(path: Path) -> Mapping[str, Any]:
    """Read a configuration file; an empty mapping where it holds something else.

    Raises:
        UsageError: if it is not YAML.
    """
    try:
        return read_yaml(path)
    except DataError as error:
        raise UsageError(f"--config {error}") from error


def argument_names(group: str) -> set[str]:
    """Arguments behind --model.… or --data.…, read from the source."""
    names = set()
    for file, name in SIGNATURES[group]:
        for node in class_definition(file, name).body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                names.add(node.target.id)
            if isinstance(node, ast.FunctionDef) and node.name == "__init__":
                names |= {argument.arg for argument in node.args.args[1:]}
    return names


def class_definition(file: str, name: str) -> ast.ClassDef:
    """A class of the package, as its source has it."""
    (kind,) = (node for node in _tree(file).body if isinstance(node, ast.ClassDef) and node.name == name)
    return kind


def class_names(module: str) -> set[str]:
    """Classes of one of `PARTS`, read from the source."""
    nodes = _tree(PARTS[module]).body
    imported = {alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names}
    return imported | {node.name for node in nodes if isinstance(node, ast.ClassDef)}


def _tree(file: str) -> ast.Module:
    return ast.parse((PACKAGE / file).read_text(encoding="utf-8"))


def _config_paths(words: Sequence[str]) -> Iterator[str]:
    for word, following in pairwise([*words, ""]):
        if word in ("--config", "-c"):
            yield following
        elif word.startswith("--config="):
            yield word.removeprefix("--config=")


def _check_options(words: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> None:
    for group in SIGNATURES:
        names = argument_names(group)
        given = [match[1] for word in words if (match := re.match(rf"--{group}\.(\w+)", word))]
        sections = [section for config in configs if isinstance(section := config.get(group), Mapping)]
        for name in [*given, *(str(key) for section in sections for key in section)]:
            if name not in names and (near := get_close_matches(name, names, n=1, cutoff=0.8)):
                option = name in given
                what = f"there is no option --{group}." if option else f"the configuration has an unknown key {group}."
                raise UsageError(f"{what}{name}; did you mean {'--' if option else ''}{group}.{near[0]}?")


def _check_classes(words: Sequence[str]) -> None:
    for option, word in pairwise(words):
        name, _, value = word.partition("=") if word.startswith("--") else (option, "", word)
        module, _, kind = value.rpartition(".")
        names = class_names(module) if module in PARTS else set()
        if kind not in names and (near := get_close_matches(kind, names, n=1)):
            raise UsageError(f"{name}: there is no {value}; did you mean {module}.{near[0]}?")


def _value(options: Mapping[str, str], configs: Sequence[Mapping[str, Any]], key: str) -> Any:
    """The value of an option, or else of the last configuration that has the key; None if none does."""
    if f"--{key}" in options:
        return options[f"--{key}"]
    section, _, name = key.rpartition(".")
    for config in reversed(configs):
        inner = config.get(section) if section else config
        if isinstance(inner, Mapping) and name in inner:
            return inner[name]
    return None


def _check_exists(option: str, value: Any, kind: str) -> None:
    if value not in NOT_FILES and "${" not in str(value) and not Path(str(value)).exists():
        raise ConfigError(f"{option} {value}: there is no such {kind}.")


def _check_dataset(name: Any) -> None:
    if name in NOT_FILES or "${" in str(name) or (PACKAGE / "sim" / "presets" / f"{name}.yaml").is_file():
        return
    from nmpm.data import catalog

    catalog.describe(str(name))
