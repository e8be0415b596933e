"""Completion of commands, options, models and files by Tab, by argcomplete; at once, as it needs no torch."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from importlib import import_module
from typing import Any

import argcomplete
from argcomplete.completers import FilesCompleter
from argcomplete.lexers import split_line

from nmpm._support.shipped import PACKAGE, config_names, entry_names, shipped_folder, user_zoo
from nmpm.cli import COMMANDS

TRAININGS = "nmpm.cli.training"
"""The module of the commands whose options are those of Lightning's parser, which takes seconds to make."""


def complete() -> None:
    """Write what the shell's line in COMP_LINE may go on with, for the shell, and exit.

    The parsers of commands are those that their `run` makes: they complete instead of parsing.
    """
    line, point = os.environ["COMP_LINE"], int(os.environ["COMP_POINT"])
    words = split_line(line, point)[3][1:]
    argparse.ArgumentParser.parse_args = _complete_by  # type: ignore[method-assign, assignment]  # (the process ends)
    if not words or words[0] not in COMMANDS:
        _complete_by(_commands())
    os.environ["_ARGCOMPLETE"] = "2"  # the command's name belongs to the program
    module = COMMANDS[words[0]][0]
    if module == TRAININGS:
        _complete_by(_training(words[0]))
    import_module(module).run([words[0], ""])


def _complete_by(parser: argparse.ArgumentParser, *_: Any) -> None:
    argcomplete.autocomplete(parser, always_complete_options=False, default_completer=complete_value)  # type: ignore[arg-type]


def _commands() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="nmpm")
    commands = parser.add_subparsers()
    for name, (_, summary) in COMMANDS.items():
        commands.add_parser(name, help=summary)
    return parser


def _training(command: str) -> argparse.ArgumentParser:
    """The more common options of a training command, read from the source as its help is."""
    from nmpm.cli.early_checks import SIGNATURES, argument_names
    from nmpm.cli.training import LINKED, OPTIONS, TRAINER

    parser = argparse.ArgumentParser(prog=f"nmpm {command}")
    keys = [f"--trainer.{key}" for names in TRAINER for key in names.split(", ")]
    keys += [f"--{group}.{key}" for group in SIGNATURES for key in sorted(argument_names(group) - LINKED[group])]
    for option in (*(name.split()[0] for name in OPTIONS), "--help_all", *keys):
        parser.add_argument(option)
    parser.add_argument("--resume" if command == "fit" else "run")
    return parser


def complete_value(prefix: str, action: argparse.Action, parser: argparse.ArgumentParser, **_: Any) -> Iterable[str]:
    """Values of an argument that begin with a prefix: models, presets or configurations, by its name; and files."""
    models = {name for zoo in (shipped_folder("zoo"), user_zoo()) for name in entry_names(zoo)}
    presets = {path.stem for path in (PACKAGE / "sim" / "presets").glob("*.yaml")}
    names = {
        "model": models,
        "models": models,
        "start_from": models,
        "dataset": presets,
        "data": presets,
        "data.name": presets,
        "config": set(config_names()),
        "ckpt_path": {"best", "last"},
        "device": {"cpu", "cuda", "mps", "auto"},
        "name": presets if parser.prog == "nmpm simulate" else models,
    }
    return [*sorted(names.get(action.dest, ())), *FilesCompleter()(prefix)]
