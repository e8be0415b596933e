"""`nmpm fit | validate | test | predict`: names and paths are checked before Lightning is imported."""

from __future__ import annotations

import sys

from nmpm._support.shipped import find_config
from nmpm.cli import COMMANDS
from nmpm.cli.early_checks import UsageError, check_command
from nmpm.cli.runs import expand_run


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
        expanded = with_shipped_configs(expanded)
        check_command(expanded)
        from nmpm.cli.run_training import run_command

        return run_command(expanded, note)
    except UsageError as error:
        sys.stderr.write(f"nmpm {words[0]}: {error}\n")
        return 2


def with_shipped_configs(words: list[str]) -> list[str]:
    """Replace the name behind each --config by the file that it means.

    Raises:
        ConfigError: if there is no such file.
    """
    found = list(words)
    for index, word in enumerate(words):
        if word in ("--config", "-c") and index + 1 < len(words):
            found[index + 1] = str(find_config(words[index + 1]))
        elif word.startswith("--config="):
            found[index] = f"--config={find_config(word.removeprefix('--config='))}"
    return found
