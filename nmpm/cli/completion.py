"""Completion of commands, options, models and files by Tab, by argcomplete; at once, as it needs no torch."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import argcomplete
from argcomplete.completers import FilesCompleter
from argcomplete.lexers import split_line

from nmpm._support.shipped import config_names, entry_names, preset_names, shipped_folder, user_zoo
from nmpm.cli.command import Command, command_parser
from nmpm.registry import Registry


def complete(commands: Registry[type[Command]], summaries: Callable[[], Mapping[str, str]]) -> None:
    """Write what the shell's line in COMP_LINE may go on with, for the shell, and exit."""
    line, point = os.environ["COMP_LINE"], int(os.environ["COMP_POINT"])
    words = split_line(line, point)[3][1:]
    if not words or words[0] not in commands:
        parser = argparse.ArgumentParser(prog="nmpm")
        added = parser.add_subparsers()
        for name, summary in summaries().items():
            added.add_parser(name, help=summary)
        argcomplete.autocomplete(parser, always_complete_options=False)
    os.environ["_ARGCOMPLETE"] = "2"  # the command's name belongs to the program
    command, prog = commands[words[0]], f"nmpm {words[0]}"
    if len(words) > 1 and words[1] in command.commands:
        os.environ["_ARGCOMPLETE"] = "3"
        command, prog = command.commands[words[1]], f"{prog} {words[1]}"
    parser = command_parser(command, prog)
    if command.commands:
        parser.add_argument("command", choices=list(command.commands))
    for action in parser._actions:
        if not action.choices:
            action.completer = complete_value  # type: ignore[attr-defined]  # (argcomplete reads it)
    parser.parse_args([])  # jsonargparse completes instead of parsing


def complete_value(prefix: str, action: argparse.Action, parser: argparse.ArgumentParser, **_: Any) -> Iterable[str]:
    """Values of an argument that begin with a prefix: models, presets or configurations, by its name; and files."""
    models = {name for zoo in (shipped_folder("zoo"), user_zoo()) for name in entry_names(zoo)}
    presets = set(preset_names())
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
