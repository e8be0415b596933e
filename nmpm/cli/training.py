"""`nmpm fit | validate | test | predict`: names and paths are checked before torch and Lightning are imported."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from nmpm._support.shipped import find_config
from nmpm.cli import COMMANDS
from nmpm.cli.early_checks import UsageError, check_command, read_config
from nmpm.errors import ConfigError

CONFIG = "config.yaml"
"""The file of a run's folder that holds its configuration."""
ROOT, CHECKPOINT = "--trainer.default_root_dir", "--ckpt_path"


def run(words: list[str]) -> int:
    """Run a training command, e.g. ["fit", "--config", "goop.yaml"] or ["test", "runs/goop"].

    Returns:
        The exit status: 2 for an option or key that cannot be.

    Raises:
        ConfigError: if a file or run that is named does not exist.
    """
    if "--help" in words or "-h" in words:
        from nmpm.cli.training_help import training_help

        sys.stdout.write(training_help(words[0], COMMANDS[words[0]][1]))
        return 0
    try:
        expanded, note = expand_run(["--help" if word == "--help_all" else word for word in words])
        expanded = _with_shipped_configs(expanded)
        check_command(expanded)
        from nmpm.cli.run_training import run_command

        return run_command(expanded, note)
    except UsageError as error:
        sys.stderr.write(f"nmpm {words[0]}: {error}\n")
        return 2


def _with_shipped_configs(words: list[str]) -> list[str]:
    """Replace the name behind each --config by the file that it means."""
    files = list(words)
    for index, word in enumerate(words):
        if word in ("--config", "-c") and index + 1 < len(words):
            files[index + 1] = str(find_config(words[index + 1]))
        elif word.startswith("--config="):
            files[index] = f"--config={find_config(word.removeprefix('--config='))}"
    return files


def expand_run(words: Sequence[str]) -> tuple[list[str], str]:
    """Replace the folder of a run by the options that it stands for.

    Args:
        words: Such as ["test", "runs/goop"] or ["fit", "--resume", "runs/goop", "--trainer.max_steps", "9000"].

    Returns:
        The words with the run's configuration, folder and checkpoint, and a line that names what further options
        change; the words as they are, and no line, where they name no run.

    Raises:
        UsageError: if `--resume` lacks the folder, or `nmpm fit` gets one without `--resume`.
        ConfigError: if the folder, its configuration or its checkpoint does not exist.
    """
    command, *options = words
    run = _take_resumed(options) if command == "fit" else _take_first(options)
    if run is None:
        return list(words), ""
    config = _run_config(run)
    given = {word.partition("=")[0] for word in options}
    implied = [] if ROOT in given else [ROOT, str(run)]
    if CHECKPOINT not in given:
        savers = ["resume"] if command == "fit" else ["checkpoint", "resume"]
        implied += [CHECKPOINT, str(_find_checkpoint(run, config, savers))]
    changes = "; ".join(_changes(options, config))
    note = f"Run: {run}{f', changed: {changes}' if changes else ''}.\n"
    return [command, "--config", str(run / CONFIG), *options, *implied], note


def _take_first(options: list[str]) -> Path | None:
    """Take the folder out of the words behind validate, test or predict."""
    return Path(options.pop(0)) if options and not options[0].startswith("-") else None


def _take_resumed(options: list[str]) -> Path | None:
    """Take `--resume RUN` out of the words behind fit."""
    if options and not options[0].startswith("-"):
        raise UsageError(f"to go on with a run, call nmpm fit --resume {options[0]}.")
    for at, (word, following) in enumerate(pairwise([*options, "-"])):
        if word == "--resume":
            if following.startswith("-"):
                raise UsageError("--resume lacks the folder of a run, such as --resume runs/goop.")
            del options[at : at + 2]
            return Path(following)
        if word.startswith("--resume="):
            del options[at]
            return Path(word.removeprefix("--resume="))
    return None


def _run_config(run: Path) -> Mapping[str, Any]:
    if run.is_file():
        raise ConfigError(f"{run} is a file: name the folder of a run, or give --config FILE {CHECKPOINT} {run}.")
    if not run.is_dir():
        raise ConfigError(f"{run}: there is no such folder.")
    if not (run / CONFIG).is_file():
        raise ConfigError(f"{run} is not the folder of a run: there is no {CONFIG} in it.")
    return read_config(run / CONFIG)


def _find_checkpoint(run: Path, config: Mapping[str, Any], savers: Sequence[str]) -> Path:
    """The checkpoint of the first of the savers that has written one."""
    paths = []
    for saver in savers:
        section = _value(config, saver) or {}
        name = section.get("filename") or {"checkpoint": "best", "resume": "last"}[saver]
        paths.append(Path(section.get("dirpath") or run / "checkpoints") / f"{name}.ckpt")
    existing = [path for path in paths if path.is_file()]
    if not existing:
        others = ", ".join(path.name for path in sorted(paths[0].parent.glob("[!.]*.ckpt"))) or "none"
        raise ConfigError(f"{run}: there is no {' or '.join(map(str, paths))}; checkpoints there: {others}.")
    return existing[0]


def _changes(options: Sequence[str], config: Mapping[str, Any]) -> Iterator[str]:
    """What options change of a configuration, such as "trainer.max_steps = 8 (was 4)"."""
    for word, following in pairwise([*options, ""]):
        name, mark, value = word.partition("=")
        if name.startswith("-"):
            new, old = value if mark else following, _value(config, name.removeprefix("--"))
            if isinstance(old, Mapping) and "class_path" in old:
                old = old["class_path"]
            if name in ("--config", "-c", ROOT, CHECKPOINT):
                yield f"{name} {new}"
            elif yaml.safe_load(new) != old:
                yield f"{name.removeprefix('--')} = {new} (was {'null' if old is None else old})"


def _value(config: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key, in which "init_args" may be left out; None if it is not stated."""
    value: Any = config
    for part in key.split("."):
        if isinstance(value, Mapping) and part not in value:
            value = value.get("init_args")
        value = value.get(part) if isinstance(value, Mapping) else None
    return value
