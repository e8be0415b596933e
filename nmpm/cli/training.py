"""`nmpm fit | validate | test | predict`: help, runs' folders, and checks before torch and Lightning are imported.

The help is read from the source. `--help_all` lists every option with type and default, also those of Lightning's
Trainer, and takes the seconds that importing Lightning takes.
"""

from __future__ import annotations

import ast
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from nmpm._support.shipped import find_config
from nmpm.cli import COMMANDS
from nmpm.cli.early_checks import SIGNATURES, UsageError, argument_names, check_command, class_definition, read_config
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


LINKED = {"model": {"scene", "recipe"}, "data": {"horizon"}}
"""Arguments that the command line takes from elsewhere."""
INDENT, WIDTH = 30, 100

HELP = """\
usage: nmpm {command} --config FILE [--SECTION.KEY VALUE ...]
       nmpm {command} {run} [--SECTION.KEY VALUE ...]

{summary}
RUN is the folder of a run, which holds its configuration; it may have been moved or copied.
Options replace what the configuration says, and later --config files what earlier ones say. What
none of them says has the default that --help_all shows.

examples:
{examples}

options:
{options}

--model.KEY:
{model}

--data.KEY:
{data}

--trainer.KEY, of Lightning's Trainer, such as:
{trainer}

--checkpoint.KEY and --resume.KEY are of Lightning's ModelCheckpoint: which checkpoint is the best,
and how often the one to resume from is written.

more:
  nmpm {command} --help_all                  every option with type and default; takes seconds
  nmpm {command} --config goop.yaml --print_config
      the whole configuration
  nmpm {command} --model.processor.help nmpm.processors.UNet
      options of a part
"""
EXAMPLES = {
    "fit": """\
  nmpm fit --config goop.yaml                           simulate data, train, test, draw
  nmpm fit --resume runs/goop                           go on after an interruption
  nmpm fit --config goop.yaml --trainer.max_time 00:00:05 --trainer.default_root_dir runs/short
  nmpm fit --config waterdrop.yaml --data.path FOLDER   train on recorded data""",
    "validate": """\
  nmpm validate runs/goop                               its best weights""",
    "test": """\
  nmpm test runs/goop                                   its best weights
  nmpm test runs/goop --ckpt_path last                  its last ones
  nmpm test runs/goop --data.path FOLDER                on other scenes""",
    "predict": """\
  nmpm predict runs/goop                                its best weights""",
}
OPTIONS = {
    "--config FILE": "YAML; a name that is no file here is looked up among the shipped ones (nmpm --help lists them)",
    "--ckpt_path last|best|FILE": "a checkpoint of the run, or a file: fit goes on from it, the other commands run it",
    "--start_from MODEL": "fit only: start with the weights of a zoo model, a run or a checkpoint of the same parts",
    "--seed_everything N": "seed of all random numbers (default: 0)",
    "--print_config": "print the configuration that results, and stop",
}
TRAINER = {
    "default_root_dir": "folder of the run's files",
    "max_steps, max_time": "end of the training: steps, or DD:HH:MM:SS, whichever is first",
    "accelerator, devices": "where to compute: auto, cpu, gpu; how many devices, see docs/scaling.md",
    "precision": "of the network: bf16-mixed, or 32-true, which CPUs without bfloat16 take in its place",
    "val_check_interval": "steps from validation to validation",
    "enable_progress_bar": "false for none",
}


def training_help(command: str, summary: str) -> str:
    """The help of a training command.

    Args:
        command: fit, validate, test or predict.
        summary: What it does, in one sentence.
    """
    sections = {group: "\n".join(_entries(dict(_described(group)))) for group in SIGNATURES}
    shared = {"options": "\n".join(_entries(OPTIONS)), "trainer": "\n".join(_entries(TRAINER))}
    run = "--resume RUN" if command == "fit" else "RUN"
    return HELP.format(command=command, run=run, summary=summary, examples=EXAMPLES[command], **shared, **sections)


def _described(group: str) -> Iterator[tuple[str, str]]:
    """Arguments of --model.… or --data.…, in their order, and the first sentence about each."""
    names = argument_names(group) - LINKED[group]
    for file, name in SIGNATURES[group]:
        for key, text in _argument_texts(ast.get_docstring(class_definition(file, name)) or ""):
            if key in names:
                yield key, re.split(r"\. (?=[A-Z])|\.$", text)[0]


def _argument_texts(docstring: str) -> Iterator[tuple[str, str]]:
    """Names and texts of the section "Args:" of a docstring."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, flags=re.DOTALL | re.MULTILINE)
    for entry in re.split(r"\n(?=    \w)", section[1].rstrip() if section else ""):
        key, _, text = entry.strip().partition(": ")
        yield key, " ".join(text.split())


def _entries(described: dict[str, str]) -> Iterator[str]:
    for key, text in described.items():
        first, *others = textwrap.wrap(text, WIDTH - INDENT)
        start = f"  {key}".ljust(INDENT)
        yield start + first if len(start) == INDENT else f"{start}\n{' ' * INDENT}{first}"
        yield from (" " * INDENT + other for other in others)
