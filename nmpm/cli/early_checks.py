"""A training command's options, and checks of them that need neither torch nor Lightning, which take seconds to import.

The checks find the common mistakes early; the parser and the parts themselves check all that passes here again.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from nmpm._support.bounded_files import read_yaml
from nmpm._support.shipped import PACKAGE, check_dataset, find_config
from nmpm.cli import expand_home
from nmpm.cli.options import check_folder, check_model
from nmpm.errors import ConfigError, DataError

NOT_FILES = (None, "last", "best", "null", "???")
"""Values of paths that name no file."""
SIGNATURES = {
    "model": (("training/module.py", "EmulatorModule"), ("emulator/recipe.py", "EmulatorRecipe")),
    "data": (("data/datamodule.py", "TrajectoryDataModule"),),
}
"""Files and classes whose arguments are the options --model.… and --data.…; those of --trainer.… are Lightning's."""
TRAINER = ("pytorch/trainer/trainer.py", "Trainer")
SHARED = frozenset(
    (
        *("config", "c", "help", "h", "help_all", "print_config", "data", "model", "trainer", "checkpoint", "resume"),
        *("ckpt_path", "seed_everything", "weights_only", "verbose", "threads", "optimizer", "lr_scheduler"),
        *("start_from", "materials", "stride", "strict", "members"),
    )
)
"""First words of all options."""
PARTS = {
    "nmpm.processors": "processors/__init__.py",
    "nmpm.transfer": "transfer/__init__.py",
    "nmpm.decoders": "decoders.py",
    "nmpm.optimizers": "optimizers.py",
    "nmpm.metrics": "metrics/__init__.py",
}
"""Modules whose classes are named in configurations, and their files."""
_PART_FILES = {"processor": "processors/*.py", "transfer": "transfer/*.py", "decoder": "decoders.py"}
_CHOICES = {"data.source": ("disk", "simulate", "hub")}


class UsageError(Exception):
    """An option or key that does not exist, or a value of the wrong kind; the message is one line."""


class Option(NamedTuple):
    """A word of the command line that is an option, with its value if it has one, or a word on its own."""

    name: str
    value: str | None = None

    def __str__(self) -> str:
        return self.name if self.value is None else f"{self.name}={self.value}"


def read_options(words: Sequence[str]) -> list[Option]:
    """The options among words: with a value that follows or stands behind `=`, or without; and words on their own.

    The value of --config becomes the path of the file that it means; ConfigError if there is none.
    """
    options: list[Option] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        name, mark, value = word.partition("=")
        if not word.startswith("-"):
            option = Option(word)
        elif mark:
            option = Option(name, value)
        elif rest and not re.match(r"--?[a-zA-Z]", rest[0]):
            option = Option(name, rest.pop(0))
        else:
            option = Option(name)
        if option.name in ("--config", "-c") and option.value:
            option = Option("--config", str(find_config(option.value)))
        options.append(option)
    return options


def check_options(options: Sequence[Option]) -> None:
    """Check the options of a training command, and the configuration files that they name.

    Raises:
        UsageError: for a misspelt name, or a configuration that is not YAML.
        ConfigError, DataError, ZooError: if dataset, checkpoint or the model to start from do not exist.
    """
    configs = [read_config(Path(value)) for name, value in options if name == "--config" and value]
    for group in (*SIGNATURES, "trainer"):
        _check_names(group, options, configs)
    for option in options:
        _check_option(option)
        _check_class(option)
    if root := _value(options, configs, "trainer.default_root_dir"):
        check_folder("--trainer.default_root_dir", Path(str(root)))
    path = _value(options, configs, "data.path")
    _check_exists("--data.path", path, "dataset")
    _check_exists("--ckpt_path", _value(options, configs, "ckpt_path"), "checkpoint")
    start = _value(options, configs, "start_from")
    if start not in NOT_FILES and "${" not in str(start):
        check_model(str(start))
    if path in NOT_FILES and _value(options, configs, "data.source") in (None, "disk", "simulate"):
        name = _value(options, configs, "data.name")
        asks = any(
            re.match(r"--(data|config|print_config|help|help_all)$|--.*\.help$", option.name) for option in options
        )
        if (path, name) == (None, None) and not asks:
            raise ConfigError(
                "there are no data: give --data.path FOLDER, --config FILE, or --data.name and an embedded dataset"
                " (nmpm simulate --list)."
            )
        _check_dataset(name)


def read_config(path: Path) -> Mapping[str, Any]:
    """Read a configuration file; an empty mapping where it holds something else, UsageError if it is not YAML."""
    try:
        return read_yaml(path)
    except DataError as error:
        raise UsageError(f"--config {error}") from error


def stated_keys(options: Sequence[Option], group: str) -> set[str]:
    """Arguments behind --model.… or --data.… that options, or configurations that they name, state."""
    configs = [read_config(Path(value)) for name, value in options if name == "--config" and value]
    sections = [section for config in configs if isinstance(section := config.get(group), Mapping)]
    given = [name for name, _ in options if name.startswith(f"--{group}.")]
    return {str(key) for section in sections for key in section} | {name.split(".")[1] for name in given}


class Argument(NamedTuple):
    """An argument's type and default, as the source has them; the default is None where there is none."""

    type: str
    default: str | None


def arguments(group: str) -> dict[str, Argument]:
    """Arguments behind --model.…, --data.… or --trainer.… by name, read from the source."""
    if group == "trainer":
        package = Path(str(find_spec("lightning").origin)).parent  # type: ignore[union-attr]  # (it is installed)
        module = ast.parse((package / TRAINER[0]).read_text(encoding="utf-8"))
        return _class_arguments(_class_of(module, TRAINER[1]))
    found: dict[str, Argument] = {}
    for file, name in SIGNATURES[group]:
        found |= _class_arguments(class_definition(file, name))
    return found


def argument_names(group: str) -> set[str]:
    """Arguments behind --model.…, --data.… or --trainer.…."""
    return set(arguments(group))


def part_arguments() -> dict[str, str]:
    """Arguments of processors, transfers and decoders, such as width: model.processor.width."""
    named: dict[str, str] = {}
    for part, paths in _PART_FILES.items():
        for path in sorted(PACKAGE.glob(paths)):
            for kind in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(kind, ast.ClassDef):
                    named |= {name: f"model.{part}.{name}" for name in _class_arguments(kind)}
    return named


def _class_arguments(kind: ast.ClassDef) -> dict[str, Argument]:
    """Fields, and arguments of `__init__`, of a class."""
    found: list[tuple[str, ast.expr | None, ast.expr | None]] = []
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.append((node.target.id, node.annotation, node.value))
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            given = [*node.args.args[1:], *node.args.kwonlyargs]
            stated = [*node.args.defaults, *node.args.kw_defaults]
            defaults = [*[None] * (len(given) - len(stated)), *stated]
            found += [(one.arg, one.annotation, default) for one, default in zip(given, defaults, strict=True)]
    return {
        name: Argument(ast.unparse(kind) if kind else "", ast.unparse(default) if default else None)
        for name, kind, default in found
    }


def _class_of(module: ast.Module, name: str) -> ast.ClassDef:
    (kind,) = (node for node in module.body if isinstance(node, ast.ClassDef) and node.name == name)
    return kind


def class_definition(file: str, name: str) -> ast.ClassDef:
    """A class of the package, as its source has it."""
    return _class_of(ast.parse((PACKAGE / file).read_text(encoding="utf-8")), name)


def class_names(module: str) -> set[str]:
    """Classes of one of `PARTS`, read from the source."""
    names = set()
    for node in _statements(PARTS[module]):
        if isinstance(node, ast.ImportFrom):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ClassDef):
            names.add(node.name)
    return names


def _statements(file: str) -> list[ast.stmt]:
    return ast.parse((PACKAGE / file).read_text(encoding="utf-8")).body


def _check_names(group: str, options: Sequence[Option], configs: Sequence[Mapping[str, Any]]) -> None:
    prefix, names = f"--{group}.", argument_names(group)
    given = [name.removeprefix(prefix).partition(".")[0] for name, _ in options if name.startswith(prefix)]
    sections = [section for config in configs if isinstance(section := config.get(group), Mapping)]
    for name in [*given, *(str(key) for section in sections for key in section)]:
        if name not in names and name not in ("help", "class_path", "init_args"):
            what, mark = ("there is no option", "--") if name in given else ("the configuration has an unknown key", "")
            hint = nearest(f"{group}.{name}", [f"{group}.{known}" for known in names], mark)
            raise UsageError(f"{what} {mark}{group}.{name}{hint}")


def nearest(wrong: str, names: Iterable[str], mark: str) -> str:
    """A question for the nearest of the options, else for an argument of a part that is spelt like the last word."""
    near = get_close_matches(wrong, list(names), n=1, cutoff=0.8)
    if not near:
        parts = part_arguments()
        near = [parts[name] for name in get_close_matches(wrong.rpartition(".")[2], parts, n=1, cutoff=0.75)]
    return f"; did you mean {mark}{near[0]}?" if near else ". See --help_all for all there are."


_COUNTS = {"threads": "int", "members": "int"}
_SCALARS: Mapping[str, Callable[[str], object]] = {
    "int": float,
    "float": float,
    "bool": {"true": True, "false": False}.__getitem__,
}
"""What reads a value of a type; what it refuses is refused."""


def _check_option(option: Option) -> None:
    """Raise UsageError for an option that does not exist, or a value that is not a number or truth value."""
    name, value = option
    first, _, rest = name.lstrip("-").partition(".")
    if name.startswith("-") and first not in SHARED:
        raise UsageError(f"there is no option {name}{nearest(first, SHARED, '--')}")
    if "." in rest or value is None or "${" in value or value == "null":
        return
    known = _COUNTS.get(first, "")
    if first in (*SIGNATURES, "trainer"):
        known = arguments(first).get(rest, Argument("", None)).type
    kind = re.sub(r" \| None$|^Optional\[(\w+)\]$", r"\1", known)
    if kind in _SCALARS:
        try:
            _SCALARS[kind](value.lower())
        except (ValueError, KeyError) as error:
            raise UsageError(f"{name}: {value} is not of type {kind}.") from error
    if (choices := _CHOICES.get(f"{first}.{rest}")) and value not in choices:
        raise UsageError(f"{name}: {value} is not one of {', '.join(map(repr, choices))}.")


def _check_class(option: Option) -> None:
    module, _, kind = (option.value or "").rpartition(".")
    names = class_names(module) if module in PARTS else set()
    if kind not in names and (near := get_close_matches(kind, names, n=1)):
        raise UsageError(f"{option.name}: there is no {option.value}; did you mean {module}.{near[0]}?")


def _value(options: Sequence[Option], configs: Sequence[Mapping[str, Any]], key: str) -> Any:
    """The value of the last option, or else of the last configuration, that has the key; None if none does."""
    for option in reversed(options):
        if option.name == f"--{key}":
            return option.value
    section, _, name = key.rpartition(".")
    for config in reversed(configs):
        inner = config.get(section) if section else config
        if isinstance(inner, Mapping) and name in inner:
            value = inner[name]
            return expand_home(value) if isinstance(value, str) else value
    return None


def _check_exists(option: str, value: Any, kind: str) -> None:
    if value not in NOT_FILES and "${" not in str(value) and not Path(str(value)).exists():
        raise ConfigError(f"{option} {value}: there is no such {kind}.")


def _check_dataset(name: Any) -> None:
    if name not in NOT_FILES and "${" not in str(name):
        check_dataset(str(name))
