"""`nmpm fit | validate | test | predict`: their options, run by LightningCLI."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING

from nmpm.cli.command import CommandParser, HelpFormatter, command_parser, option, positional
from nmpm.cli.options import Positive, StrictReadingOptions, ThreadsOptions
from nmpm.cli.training_options import (
    CHECKPOINT,
    REPLACED,
    SECTIONS,
    add_configuration,
    check_options,
    checked_words,
    expand_run,
    forget_unused_slurm,
    known_options,
    names_in,
    read_options,
    scalar_type,
)
from nmpm.cli.trust import OPTION
from nmpm.errors import ConfigError

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, kw_only=True)
class Training(StrictReadingOptions, ThreadsOptions):
    """A training or evaluation by LightningCLI; options of its own, and of LightningCLI by the stored table.

    Args:
        config: YAML; a name that is no file here is looked up among the shipped ones (nmpm --help lists them).
        ckpt_path: A checkpoint of the run, or a file: fit goes on from it, the other commands run it.
        seed_everything: Seed of all random numbers (default: 0).
        print_config: Print the configuration that results, and stop.
        trust_config: Run what the configuration of RUN names although nmpm did not write it.
        threads: Of a CPU, which compute parts of a batch (default: OMP_NUM_THREADS; else the faster of one and all that
            may be used, as measured). Another number changes results by rounding.
    """

    config: str | None = option(metavar="FILE")
    ckpt_path: str | None = option(metavar="last|best|FILE", label=CHECKPOINT)
    seed_everything: str | None = option(metavar="N", label="--seed_everything")
    print_config: bool = option(False, label="--print_config")
    trust_config: bool = False

    @classmethod
    def add_arguments(cls, parser: CommandParser) -> None:
        """Add the arguments behind --model., --data. and --trainer.; those without a text are hidden in the help."""
        run = "--resume RUN" if issubclass(cls, Fit) else "RUN"
        parser.usage = "".join(
            f"{start} {words} [--SECTION.KEY VALUE ...]"
            for start, words in ((parser.prog, "--config FILE"), (f"\n       {parser.prog}", run))
        )
        parser.formatter_class = partial(HelpFormatter, max_help_position=30)  # type: ignore[assignment]  # (made alike)
        parser.allow_abbrev = False
        parser.parts = known_options()["parts"]
        for name in ("--weights_only", "--verbose", "--help_all"):
            parser.add_argument(name, nargs="?", help=argparse.SUPPRESS)
        for section, title in SECTIONS.items():
            group = parser.add_argument_group(title)
            for key, argument in known_options()[section].items():
                default = "" if argument["default"] is None else f"; default: {argument['default']}"
                text = argument["text"] and f"{argument['text']} ({argument['type']}{default})".replace("%", "%%")
                name = f"--{section}.{key}"
                group.add_argument(name, type=scalar_type(argument), metavar="", help=text or argparse.SUPPRESS)

    @classmethod
    def run_words(cls, prog: str, words: Sequence[str]) -> int:
        """Check what can be checked at once, and run the command by LightningCLI."""
        parser = command_parser(cls, prog)
        if not {"-h", "--help"}.isdisjoint(words):
            parser.parse_args(["--help"])
        command = prog.split()[-1]
        forget_unused_slurm()
        own = read_options(words, [name for name, action in parser._option_string_actions.items() if action.nargs == 0])
        options, note = expand_run(command, own)
        values = parser.parse_args([word for one in own for word in checked_words(one)])
        cls(**{one.name: values[one.name] for one in fields(cls)})
        options = [one for one in options if one.name != OPTION]
        check_options(options)
        options = add_configuration(options) if command == "fit" else options
        from nmpm.cli.run_training import run_command

        trusted = None if values["trust_config"] or not note else names_in(own)
        return run_command([command, *(REPLACED.get(word, word) for word in map(str, options))], note, trusted)


@dataclass(frozen=True, kw_only=True)
class Fit(Training):
    """Train an emulator, then test the best checkpoint once.

    RUN is the folder of a run, which holds its configuration; it may have been moved or copied. Options replace what
    the configuration says, and later --config files what earlier ones say. What none of them says has the default that
    --help_all shows. --checkpoint.KEY and --resume.KEY are of Lightning's ModelCheckpoint: which checkpoint is the
    best, and how often the one to resume from is written.

    Args:
        resume: Go on with the run in this folder after an interruption.
        start_from: Start with a zoo model, a run or a checkpoint, with its cells, network, transfer, decoder and
            constraints; without --config, train as fine-tunings do, for five minutes.

    Examples:
        nmpm fit --config goop.yaml                           simulate data, train, test, draw
        nmpm fit --resume runs/goop                           go on after an interruption
        nmpm fit --config goop.yaml --trainer.max_time 00:00:05 --trainer.default_root_dir runs/short
        nmpm fit --data.path FOLDER                           on your own data, configured as by init
        nmpm fit --start_from sandramps --data.path FOLDER --materials big=sand,small=sand
                                                              ... from a pretrained model, in five minutes
        nmpm fit --config waterdrop.yaml --data.path FOLDER   on recorded data, by another

        nmpm fit --help_all                                   every option; takes seconds
        nmpm fit --config goop.yaml --print_config            the whole configuration
        nmpm fit --model.processor.help nmpm.processors.UNet  options of a part
    """

    resume: str | None = option(metavar="RUN")
    start_from: str | None = option(metavar="MODEL", label="--start_from")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("materials", "stride", "strict"):
            if getattr(self, name) and not self.start_from:
                raise ConfigError(f"--{name} is of --start_from MODEL: data are matched to a model that there is.")


@dataclass(frozen=True, kw_only=True)
class Evaluation(Training):
    """An evaluation of a checkpoint.

    Args:
        folder: The folder of a run, which holds its configuration and checkpoints; it may have been moved or copied.
            Options replace what the configuration says.
    """

    folder: str | None = positional(metavar="RUN")


@dataclass(frozen=True, kw_only=True)
class Validate(Evaluation):
    """Roll a checkpoint out over the valid split.

    Examples:
        nmpm validate runs/goop                               its best weights
    """


@dataclass(frozen=True, kw_only=True)
class Test(Evaluation):
    """Roll a checkpoint out over the test split; write table, picture and animation.

    Args:
        members: Score so many rollouts of each scene as an ensemble, too: fair CRPS, spread over skill.

    Examples:
        nmpm test runs/goop                                   its best weights
        nmpm test runs/goop --ckpt_path last                  its last ones
        nmpm test runs/goop --data.path FOLDER                on other scenes
    """

    members: Positive | None = option(metavar="M")


@dataclass(frozen=True, kw_only=True)
class Predict(Evaluation):
    """Roll a checkpoint out over the test split and write the trajectories.

    Examples:
        nmpm predict runs/goop                                its best weights
    """
