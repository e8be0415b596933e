"""`nmpm fit | validate | test | predict`: help, runs' folders, and checks before torch and Lightning are imported.

The help is read from the source. `--help_all` lists every option with type and default, also those of Lightning's
Trainer, and takes the seconds that importing Lightning takes.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from nmpm._support.messages import counted
from nmpm._support.shipped import PACKAGE
from nmpm.cli import COMMANDS
from nmpm.cli.early_checks import (
    NOT_FILES,
    SIGNATURES,
    Option,
    UsageError,
    arguments,
    check_options,
    class_definition,
    read_config,
    read_options,
)
from nmpm.cli.match_options import MatchOptions
from nmpm.cli.run_folder import CONFIG, RunFolder
from nmpm.cli.trust import NAME, OPTION, foreign_names, trust_advice
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    from nmpm.data.convert import Options

FINE_TUNING = PACKAGE / "cli" / "fine_tune.yaml"
"""The configuration of fine-tunings that name none."""
ROOT, CHECKPOINT = "--trainer.default_root_dir", "--ckpt_path"


FEWEST_STEPS = 2_000
"""Steps of single particles, from frame to frame, from which on a training is started without being asked for."""
_REPLACED = {"--help_all": "--help", "--strict": "--strict=true"}


def run(words: list[str]) -> int:
    """Run a training command, e.g. ["fit", "--config", "goop.yaml"], and return the exit status."""
    command = words[0]
    if "--help" in words or "-h" in words:
        sys.stdout.write(training_help(command, COMMANDS[command][1]))
        return 0
    forget_unused_slurm()
    try:
        options = read_options([_REPLACED.get(word, word) for word in words[1:]])
        trusts = Option(OPTION) in options
        own = [option for option in options if option.name != OPTION]
        options, note = expand_run(command, own)
        if not trusts:
            check_trust(own, options)
        check_options(options)
        check_match_options(command, options)
        options = add_configuration(options) if command == "fit" else options
        from nmpm.cli.run_training import run_command

        return run_command([command, *map(str, options)], note, None if trusts or own == options else names_in(own))
    except UsageError as error:
        sys.stderr.write(f"nmpm {command}: {error}\n")
        return 2


def names_in(options: Sequence[Option]) -> frozenset[str]:
    """Dotted names in options and in the configurations that they name, which are the user's own."""
    configs = [Path(value).read_text(encoding="utf-8") for name, value in options if name == "--config" and value]
    return frozenset(NAME.findall("\n".join([*map(str, options), *configs])))


def check_trust(own: Sequence[Option], options: Sequence[Option]) -> None:
    """Raise ConfigError if the configuration of a run, which options have beside the user's own, names foreign code."""
    for name, value in options:
        if name == "--config" and value and Option(name, value) not in own:
            for foreign in foreign_names(read_config(Path(value)), names_in(own)):
                raise ConfigError(f"{value} {trust_advice(foreign)}")


def forget_unused_slurm() -> None:
    """Remove SLURM's number of tasks from the environment of a process that srun has not started as one of them.

    In an interactive job, or a batch script without srun, there is one process: Lightning would wait for the others.
    """
    if not {"SLURM_STEP_ID", "SLURM_STEPID"} & os.environ.keys() or "SLURM_PTY_PORT" in os.environ:
        os.environ.pop("SLURM_NTASKS", None)


def check_match_options(command: str, options: Sequence[Option]) -> None:
    """Raise ConfigError if --materials or --stride cannot be read, or a training that starts from no model has them."""
    given = {option.name: option.value for option in options}
    MatchOptions.read(given.get("--materials"), given.get("--stride"))
    if command == "fit" and "--start_from" not in given:
        for name in ("--materials", "--stride", "--strict"):
            if name in given:
                raise ConfigError(f"{name} is of --start_from MODEL: data are matched to a model that there is.")


def add_configuration(options: Sequence[Option]) -> list[Option]:
    """The options with a configuration for --data.path, where they name none.

    That of fine-tunings where they start from a model, or else one that is written for the data.

    Raises:
        ConfigError: in one of several processes, which would write different ones; for too little data.
    """
    given = {option.name: option.value for option in options}
    path = given.get("--data.path")
    if path is None or path in NOT_FILES or "--config" in given or "--print_config" in given:
        return list(options)
    from nmpm.data.convert import Options
    from nmpm.data.new_configuration import OPTIONS

    stated = {name: yaml.safe_load(given.get(f"--data.{name}") or "null") for name in OPTIONS}
    stated["prescribed"] = stated["prescribed"] and frozenset(stated["prescribed"])
    facts = Options(**stated)
    if not {"--trainer.max_steps", "--trainer.max_time"} & given.keys():
        check_enough_data(Path(path), facts)
    if "--start_from" in given:
        return _add_fine_tuning(options, Path(path))
    if any(int(os.environ.get(name) or 1) > 1 for name in ("WORLD_SIZE", "SLURM_NTASKS")):
        raise ConfigError(f"Several processes need one --config: write it first, by nmpm init {path}.")
    from nmpm.cli.init import MINUTES, dataset_name, write_for_fit

    root = Path(given.get(ROOT) or f"runs/{dataset_name(Path(path))}")
    minutes = _minutes(given.get("--trainer.max_time") or "") or MINUTES
    return [Option("--config", str(write_for_fit(Path(path), facts, root, minutes))), *options]


def check_enough_data(path: Path, facts: Options) -> None:
    """Raise ConfigError if there is so little to train on that the minutes of a training would be wasted."""
    from nmpm.data.format import Split
    from nmpm.data.loading.sources import FolderSource
    from nmpm.data.split_files import split_paths

    source = FolderSource(path, facts)
    splits = split_paths(source.folder)
    split = Split(splits.get("train") or next(iter(splits.values())))
    frames = [split.frames(index) for index in range(len(split))]
    particles = [int(source.metadata.is_moving(split.particle_type(index)).sum()) for index in range(len(split))]
    steps = sum(max(0, count - 2) * moving for count, moving in zip(frames, particles, strict=True))
    if steps < FEWEST_STEPS:
        raise ConfigError(
            f"{path}: too little to learn from: {counted(sum(frames), 'frame')} of at most"
            f" {counted(max(particles), 'particle')} to train on are {steps:,} steps of particles; {FEWEST_STEPS:,} are"
            " the fewest. Add trajectories, or longer ones; --trainer.max_time 00:00:15:00 trains on these anyway."
        )


def _add_fine_tuning(options: Sequence[Option], path: Path) -> list[Option]:
    """The options with the configuration of fine-tunings, and a run's folder of the dataset's name."""
    from nmpm.cli.init import dataset_name

    given = {option.name: option.value for option in options}
    root = given.get(ROOT) or f"runs/{dataset_name(path)}"
    return [Option("--config", str(FINE_TUNING)), Option(ROOT, root), *options]


def _minutes(time: str) -> float | None:
    """The minutes of DD:HH:MM:SS; None for another form."""
    parts = re.fullmatch(r"(\d+):(\d+):(\d+):(\d+)", time)
    if parts is None:
        return None
    days, hours, minutes, seconds = map(int, parts.groups())
    return 1440 * days + 60 * hours + minutes + seconds / 60


def expand_run(command: str, options: Sequence[Option]) -> tuple[list[Option], str]:
    """Replace "runs/goop", or "--resume runs/goop" of fit, by the run's configuration, folder and checkpoint.

    Returns:
        The options, and a line that says what those beside the run change of it; empty where there is no run.

    Raises:
        UsageError: if `--resume` lacks the folder, or `nmpm fit` gets one without `--resume`.
        ConfigError: if the folder, its configuration or its checkpoint does not exist.
    """
    first = options[0].name if options and not options[0].name.startswith("-") else None
    if command != "fit":
        run, others = first, list(options[1:] if first else options)
    elif first:
        raise UsageError(f"to go on with a run, call nmpm fit --resume {first}.")
    else:
        resumed = [option for option in options if option.name == "--resume"]
        if any(not option.value for option in resumed):
            raise UsageError("--resume lacks the folder of a run, such as --resume runs/goop.")
        run, others = resumed[-1].value if resumed else None, [one for one in options if one.name != "--resume"]
    if run is None:
        return others, ""
    root = Path(run)
    config = _run_config(root)
    names = {option.name for option in others}
    implied = [] if ROOT in names else [Option(ROOT, run)]
    if names & {"--data.path", "--data.name"} and _stated_value(config, "data.reading"):
        implied.append(Option("--data.reading", "null"))  # it is that of the run's data
    if CHECKPOINT not in names:
        checkpoint = RunFolder.of(root, config).checkpoint(*(["last"] if command == "fit" else ["best", "last"]))
        implied.append(Option(CHECKPOINT, str(checkpoint)))
    changes = "; ".join(_changes(others, config))
    note = f"Run: {run}{f', changed: {changes}' if changes else ''}.\n"
    return [Option("--config", str(root / CONFIG)), *others, *implied], note


def _run_config(run: Path) -> Mapping[str, Any]:
    if run.is_file():
        raise ConfigError(f"{run} is a file: name the folder of a run, or give --config FILE {CHECKPOINT} {run}.")
    if not run.is_dir():
        raise ConfigError(f"{run}: there is no such folder.")
    if not (run / CONFIG).is_file():
        raise ConfigError(f"{run} is not the folder of a run: there is no {CONFIG} in it.")
    return read_config(run / CONFIG)


def _changes(options: Sequence[Option], config: Mapping[str, Any]) -> Iterator[str]:
    """What options change of a configuration, such as "trainer.max_steps = 8 (was 4)"."""
    for name, value in options:
        if name in ("--config", ROOT, CHECKPOINT):
            yield f"{name} {value}"
        elif value is not None:
            key = name.removeprefix("--")
            old = _stated_value(config, key)
            if isinstance(old, Mapping) and "class_path" in old:
                old = old["class_path"]
            if yaml.safe_load(value) != old:
                yield f"{key} = {value} (was {'null' if old is None else old})"


def _stated_value(config: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key, in which "init_args" may be left out; None if it is not stated."""
    value: Any = config
    for part in key.split("."):
        if isinstance(value, Mapping) and part not in value:
            value = value.get("init_args")
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


LINKED = {"model": {"scene", "recipe"}, "data": {"horizon"}}
"""Arguments that the command line takes from elsewhere."""
INDENT = 30

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
  nmpm fit --data.path FOLDER                           on your own data, configured as by init
  nmpm fit --start_from sandramps --data.path FOLDER --materials big=sand,small=sand
                                                        ... from a pretrained model, in five minutes
  nmpm fit --config waterdrop.yaml --data.path FOLDER   on recorded data, by another""",
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
    "--start_from MODEL": "fit only: start with a zoo model, a run or a checkpoint, with its cells, network and"
    " constraints; without --config, train as fine-tunings do, for five minutes",
    "--materials DATA=MODEL,...": "of a model on data of another kind: which of its materials each of the data's is",
    "--stride K": "likewise: frames of the data for one of the model, such as 2 or 1/4 (default: what matches best)",
    "--strict": "likewise: refuse data whose gravity, frames, particles, speeds or walls are not the model's",
    "--members N": "test only: score so many rollouts of each scene as an ensemble, too",
    "--trust-config": "run what the configuration of RUN names although nmpm did not write it",
    "--seed_everything N": "seed of all random numbers (default: 0)",
    "--print_config": "print the configuration that results, and stop",
}
TRAINER = {
    "default_root_dir": "folder of the run's files; further runs go to its version_1, version_2, ...",
    "max_steps, max_time": "end of the training: steps, or DD:HH:MM:SS, whichever is first",
    "accelerator, devices": "where to compute: auto, cpu, gpu; how many devices, see docs/scaling.md",
    "precision": "of the network: bf16-mixed, or 32-true, which CPUs without bfloat16 take in its place",
    "val_check_interval": "steps from validation to validation",
    "enable_progress_bar": "false for none",
}


def training_help(command: str, summary: str) -> str:
    """The help of a training command, with a sentence that says what it does."""
    sections = {group: "\n".join(_entries(dict(_described(group)))) for group in SIGNATURES}
    shared = {"options": "\n".join(_entries(OPTIONS)), "trainer": "\n".join(_entries(TRAINER))}
    run = "--resume RUN" if command == "fit" else "RUN"
    return HELP.format(command=command, run=run, summary=summary, examples=EXAMPLES[command], **shared, **sections)


def _described(group: str) -> Iterator[tuple[str, str]]:
    """Arguments of --model.… or --data.…, in their order: the first sentence about each, type and default."""
    known = arguments(group)
    for file, name in SIGNATURES[group]:
        for key, text in _argument_texts(ast.get_docstring(class_definition(file, name)) or ""):
            if key in known and key not in LINKED[group]:
                default = "" if known[key].default in (None, "None") else f"; default: {known[key].default}"
                yield key, f"{re.split(r'[.] (?=[A-Z])|[.]$', text)[0]} ({known[key].type}{default})"


def _argument_texts(docstring: str) -> Iterator[tuple[str, str]]:
    """Names and texts of the section "Args:" of a docstring."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, flags=re.DOTALL | re.MULTILINE)
    for entry in re.split(r"\n(?=    \w)", section[1].rstrip() if section else ""):
        key, _, text = entry.strip().partition(": ")
        yield key, " ".join(text.split())


def _entries(described: dict[str, str]) -> Iterator[str]:
    for key, text in described.items():
        first, *others = textwrap.wrap(text, max(60, shutil.get_terminal_size().columns) - INDENT)
        start = f"  {key}".ljust(INDENT)
        yield start + first if len(start) == INDENT else f"{start}\n{' ' * INDENT}{first}"
        yield from (" " * INDENT + other for other in others)
