"""Options of trainings as words of the command line: read by a stored table, and checked before torch is imported."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import yaml

from nmpm._support.bounded_files import read_yaml
from nmpm._support.former import LOSS_OPTIONS, with_loss
from nmpm._support.messages import counted
from nmpm._support.shipped import PACKAGE, check_dataset, find_config
from nmpm.cli import expand_home
from nmpm.cli.command import UsageError, nearest
from nmpm.cli.options import check_folder, check_model
from nmpm.cli.run_folder import CONFIG, RunFolder
from nmpm.cli.trust import NAME, OPTION, foreign_names, trust_advice
from nmpm.errors import ConfigError, DataError

if TYPE_CHECKING:
    from nmpm.data.convert import Options

OPTIONS_FILE = PACKAGE / "cli" / "training_options.json"
FINE_TUNING = PACKAGE / "cli" / "fine_tune.yaml"
"""The configuration of fine-tunings that name none."""
ROOT, CHECKPOINT = "--trainer.default_root_dir", "--ckpt_path"
NOT_FILES = (None, "last", "best", "null", "???")
"""Values of paths that name no file."""
FEWEST_STEPS = 2_000
"""Steps of single particles, from frame to frame, from which on a training is started without being asked for."""
SECTIONS = {"model": "the model", "data": "the data", "trainer": "Lightning's Trainer, such as"}
_UNCHECKED = ("checkpoint", "resume", "optimizer", "lr_scheduler")
"""Sections of options that are not stored."""
REPLACED = {"--help_all": "--help", "--strict": "--strict=true"}
"""Words of LightningCLI's parser for flags."""


@cache
def known_options() -> Mapping[str, Any]:
    """Types, defaults and texts of the arguments of model, data and trainer.

    They are stored, as the classes take seconds to import; `python benchmarks/training_options.py` writes them anew.
    """
    known: dict[str, Any] = json.loads(OPTIONS_FILE.read_text(encoding="utf-8"))
    if metadata.version("lightning") != known.pop("lightning"):
        known["trainer"] = {}  # another version's arguments: its own parser knows them
    return known


class Option(NamedTuple):
    """A word of the command line that is an option, with its value if it has one, or a word on its own."""

    name: str
    value: str | None = None

    def __str__(self) -> str:
        return self.name if self.value is None else f"{self.name}={self.value}"


def read_options(words: Sequence[str], flags: Sequence[str] = ()) -> list[Option]:
    """The options among words: with a value that follows or stands behind `=`, or without; and words on their own.

    The value of --config becomes the path of the file that it means; ConfigError if there is none.
    """
    options: list[Option] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        name, mark, value = word.partition("=")
        if not word.startswith("-"):
            read = Option(word)
        elif mark:
            read = Option(name, value)
        elif name not in flags and rest and not re.match(r"--?[a-zA-Z]", rest[0]):
            read = Option(name, rest.pop(0))
        else:
            read = Option(name)
        if (former := read.name.removeprefix("--model.")) in LOSS_OPTIONS and former != read.name:
            read = Option(f"--model.loss.init_args.{LOSS_OPTIONS[former]}", read.value)
        if read.name in ("--config", "-c") and read.value:
            read = Option("--config", str(find_config(read.value)))
        options.append(read)
    return options


def checked_words(one: Option) -> Iterator[str]:
    """The words of an option for the stored parser, which has no arguments of parts and reads no references."""
    section, _, rest = one.name.removeprefix("--").rstrip("+").partition(".")
    if section in _UNCHECKED or (section in SECTIONS and (rest in ("", "help") or not known_options()[section])):
        return
    if one.name != "--print_config" and one.value != "null" and "${" not in (one.value or ""):
        name = ".".join(one.name.rstrip("+").split(".")[:2])
        yield str(Option(name, one.value))


def scalar_type(argument: Mapping[str, Any]) -> Any:
    """The type of a stored argument that the stored parser checks; None for those that are classes or sequences."""
    scalars = {"int": int, "float": float, "bool": bool, "SourceName": Literal["disk", "simulate", "hub"]}
    return scalars.get(re.sub(r" \| None$|^Optional\[(\w+)\]$", r"\1", argument["type"]))


def read_config(path: Path) -> Mapping[str, Any]:
    """Read a configuration file; an empty mapping where it holds something else, UsageError if it is not YAML."""
    try:
        config = dict(read_yaml(path))
    except DataError as error:
        raise UsageError(f"--config {error}") from error
    return config | ({"model": with_loss(config["model"])} if isinstance(config.get("model"), Mapping) else {})


def _configs(options: Sequence[Option]) -> list[Mapping[str, Any]]:
    """The configuration files that options name."""
    return [read_config(Path(value)) for name, value in options if name == "--config" and value]


def _keys(configs: Sequence[Mapping[str, Any]], section: str) -> list[str]:
    """The keys of a section of configurations."""
    return [str(key) for config in configs if isinstance(keys := config.get(section), Mapping) for key in keys]


def stated_keys(options: Sequence[Option], section: str) -> set[str]:
    """Arguments behind --model.… or --data.… that options, or configurations that they name, state."""
    given = {name.split(".")[1] for name, _ in options if name.startswith(f"--{section}.")}
    return given.union(_keys(_configs(options), section))


def check_options(options: Sequence[Option]) -> None:
    """Check keys of configurations, names of classes, and that files, data and models exist.

    Raises:
        UsageError: for a misspelt name, or a configuration that is not YAML.
        ConfigError, DataError, ZooError: if dataset, checkpoint or the model to start from do not exist.
    """
    configs = _configs(options)
    for section in SECTIONS:
        names = known_options()[section]
        for key in _keys(configs, section):
            if names and key not in (*names, "class_path", "init_args"):
                wrong, all_names = f"{section}.{key}", [f"{section}.{name}" for name in names]
                hint = nearest(wrong, all_names, known_options()["parts"], "")
                raise UsageError(f"the configuration has an unknown key {wrong}{hint}")
    for one in options:
        module, _, kind = (one.value or "").rpartition(".")
        classes = known_options()["classes"].get(module, ())
        if kind not in classes and (near := get_close_matches(kind, classes, n=1)):
            raise UsageError(f"{one.name}: there is no {one.value}; did you mean {module}.{near[0]}?")
    keys = ("trainer.default_root_dir", "data.path", "ckpt_path", "start_from", "data.source", "data.name")
    values = {key: _value(options, configs, key) for key in keys}
    stated = {key: str(value) for key, value in values.items() if value not in NOT_FILES and "${" not in str(value)}
    if values["trainer.default_root_dir"]:
        check_folder(ROOT, Path(str(values["trainer.default_root_dir"])))
    for key, noun in (("data.path", "dataset"), ("ckpt_path", "checkpoint")):
        if key in stated and not Path(stated[key]).exists():
            raise ConfigError(f"--{key} {stated[key]}: there is no such {noun}.")
    if "start_from" in stated:
        check_model(stated["start_from"])
    if values["data.path"] in NOT_FILES and values["data.source"] in (None, "disk", "simulate"):
        asks = re.compile(r"--(data|config|print_config|help_all)|--.*\.help")
        if values["data.path"] is values["data.name"] is None and not any(asks.fullmatch(one.name) for one in options):
            raise ConfigError(
                "there are no data: give --data.path FOLDER, --config FILE, or --data.name and an embedded dataset"
                " (nmpm simulate --list)."
            )
        if "data.name" in stated:
            check_dataset(stated["data.name"])


def _value(options: Sequence[Option], configs: Sequence[Mapping[str, Any]], key: str) -> Any:
    """The value of the last option, or else of the last configuration, that has the key; None if none does."""
    given = [option.value for option in options if option.name == f"--{key}"]
    stated = [value for config in configs if (value := _stated_value(config, key, missing=...)) is not ...]
    value = (given or stated or [None])[-1]
    return expand_home(value) if isinstance(value, str) else value


def names_in(options: Sequence[Option]) -> frozenset[str]:
    """Dotted names in options and in the configurations that they name, which are the user's own."""
    configs = [Path(value).read_text(encoding="utf-8") for name, value in options if name == "--config" and value]
    return frozenset(NAME.findall("\n".join([*map(str, options), *configs])))


def forget_unused_slurm() -> None:
    """Remove SLURM's number of tasks from the environment of a process that srun has not started as one of them.

    In an interactive job, or a batch script without srun, there is one process: Lightning would wait for the others.
    """
    if not {"SLURM_STEP_ID", "SLURM_STEPID"} & os.environ.keys() or "SLURM_PTY_PORT" in os.environ:
        os.environ.pop("SLURM_NTASKS", None)


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
    from nmpm.cli.init import MINUTES, dataset_name, write_for_fit
    from nmpm.data.convert import Options
    from nmpm.data.new_configuration import OPTIONS

    facts = Options(**{name: yaml.safe_load(given.get(f"--data.{name}") or "null") for name in OPTIONS})
    if not {"--trainer.max_steps", "--trainer.max_time"} & given.keys():
        check_enough_data(Path(path), facts)
    root = given.get(ROOT) or f"runs/{dataset_name(Path(path))}"
    if "--start_from" in given:
        return [Option("--config", str(FINE_TUNING)), Option(ROOT, root), *options]
    if any(int(os.environ.get(name) or 1) > 1 for name in ("WORLD_SIZE", "SLURM_NTASKS")):
        raise ConfigError(f"Several processes need one --config: write it first, by nmpm init {path}.")
    time = re.fullmatch(r"(\d+):(\d+):(\d+):(\d+)", given.get("--trainer.max_time") or "")
    days, hours, minutes, seconds = map(int, time.groups()) if time else (0, 0, 0, 0)
    budget = 1440 * days + 60 * hours + minutes + seconds / 60
    return [Option("--config", str(write_for_fit(Path(path), facts, Path(root), budget or MINUTES))), *options]


def check_enough_data(path: Path, facts: Options) -> None:
    """Raise ConfigError if there is so little to train on that the minutes of a training would be wasted."""
    from nmpm.data.format import Split, split_paths
    from nmpm.data.sources import FolderSource

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


def expand_run(command: str, options: Sequence[Option]) -> tuple[list[Option], str]:
    """Replace "runs/goop", or "--resume runs/goop" of fit, by the run's configuration, folder and checkpoint.

    Returns:
        The options, and a line that says what those beside the run change of it; empty where there is no run.

    Raises:
        UsageError: if `--resume` lacks the folder, or `nmpm fit` gets one without `--resume`.
        ConfigError: if the folder, its configuration or its checkpoint does not exist, or it names foreign code.
    """
    runs = [one.name for one in options if not one.name.startswith("-")]
    if command == "fit":
        if runs:
            raise UsageError(f"to go on with a run, call nmpm fit --resume {runs[0]}.")
        resumed = [one.value for one in options if one.name == "--resume"]
        if not all(resumed):
            raise UsageError("--resume lacks the folder of a run, such as --resume runs/goop.")
        runs = [run for run in resumed if run]
    others = [one for one in options if one.name.startswith("-") and (command, one.name) != ("fit", "--resume")]
    if not runs:
        return others, ""
    run, root = runs[-1], Path(runs[-1])
    if root.is_file():
        raise ConfigError(f"{run} is a file: name the folder of a run, or give --config FILE {CHECKPOINT} {run}.")
    if not root.is_dir():
        raise ConfigError(f"{run}: there is no such folder.")
    if not (root / CONFIG).is_file():
        raise ConfigError(f"{run} is not the folder of a run: there is no {CONFIG} in it.")
    config = read_config(root / CONFIG)
    if Option(OPTION) not in options:
        for foreign in foreign_names(config, names_in(options)):
            raise ConfigError(f"{root / CONFIG} {trust_advice(foreign)}")
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


def _stated_value(config: Mapping[str, Any], key: str, missing: Any = None) -> Any:
    """The value of a dotted key, in which "init_args" may be left out."""
    value: Any = config
    for part in key.split("."):
        if isinstance(value, Mapping) and part not in value:
            value = value.get("init_args")
        if not isinstance(value, Mapping) or part not in value:
            return missing
        value = value[part]
    return value
