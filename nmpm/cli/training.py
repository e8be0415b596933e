"""`nmpm fit | validate | test | predict`: files are checked before Lightning, which takes seconds, is imported."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from nmpm._support.shipped import find_config
from nmpm.errors import ConfigError

FILES = {"--data.path": "dataset", "--ckpt_path": "checkpoint"}
NOT_FILES = ("last", "best", "null")


def run(words: list[str]) -> int:
    """Run a training command, e.g. ["fit", "--config", "goop.yaml"].

    Returns:
        The exit status.

    Raises:
        ConfigError: if a file that an option names does not exist.
    """
    found = with_shipped_configs(words)
    check_files(found)
    from nmpm.cli.emulator_cli import run_command

    return run_command(words, found)


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


def check_files(words: list[str]) -> None:
    """Make sure that dataset and checkpoint exist.

    Raises:
        ConfigError: naming the option.
    """
    options = dict(pairwise(words)) | dict(word.split("=", 1) for word in words if "=" in word)
    for option, kind in FILES.items():
        value = options.get(option)
        if value is not None and value not in NOT_FILES and not Path(value).exists():
            raise ConfigError(f"{option} {value}: there is no such {kind}.")
