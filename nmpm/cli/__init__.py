"""The command line. `nmpm --help` answers at once: what a command needs is imported when the command runs."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches

from nmpm._support import __version__
from nmpm._support.messages import plain_warnings, unfailing_output
from nmpm._support.threads import limit_spinning
from nmpm.cli.command import Command, run_command, summary
from nmpm.errors import NmpmError
from nmpm.registry import Registry

COMMANDS: Registry[type[Command]] = Registry(
    "nmpm.commands",
    "command",
    {
        "fit": "nmpm.cli.training:Fit",
        "validate": "nmpm.cli.training:Validate",
        "test": "nmpm.cli.training:Test",
        "predict": "nmpm.cli.training:Predict",
        "simulate": "nmpm.cli.simulate:Simulate",
        "convert": "nmpm.cli.convert:Convert",
        "init": "nmpm.cli.init:Init",
        "inspect": "nmpm.cli.inspect:Inspect",
        "zoo": "nmpm.cli.zoo:ZooCommands",
        "demo": "nmpm.cli.demo:Demo",
        "rollout": "nmpm.cli.rollout:RollOut",
        "stress": "nmpm.cli.measure:Stress",
        "compare": "nmpm.cli.measure:Compare",
        "trade": "nmpm.cli.measure:Trade",
        "export": "nmpm.cli.export:Export",
        "render": "nmpm.cli.pages:Render",
        "play": "nmpm.cli.pages:Play",
        "view": "nmpm.cli.pages:View",
        "doctor": "nmpm.cli.doctor:Doctor",
    },
)

USAGE = """usage: nmpm COMMAND [OPTIONS]

Emulators of particle simulations on a grid: train them, evaluate them by rollouts, use pretrained
ones.

commands:
{commands}

first steps:
  nmpm demo                                    a simulator and its emulator, side by side
  nmpm fit --config goop.yaml                  simulate the goop dataset, train on it, test, draw
  nmpm fit --resume runs/goop                  go on after an interruption
  nmpm inspect FOLDER                          summarise recorded data of any format known
  nmpm init FOLDER                             write a configuration for it: FOLDER.yaml
  nmpm fit --config FOLDER.yaml                train on it; or at once: nmpm fit --data.path FOLDER
  nmpm zoo match FOLDER                        which pretrained model predicts it, or to start from
  nmpm rollout goop --frames 400 --out out.h5  roll a pretrained model out
  nmpm render out.h5                           draw the rollout
  nmpm view out.h5                             play it in a browser
  nmpm play waterramps                         throw, pour and drag, live in a browser
  nmpm stress goop                             test it at the extremes
  nmpm compare waterramps --data waterdrop-xl  does a model hold for other scenes than its own?
  nmpm trade goop                              what accuracy costs in time: model or simulator?

Add --help to any command for its options and examples; nmpm --version prints the version.
Tab completes commands, options and models in bash and zsh after
  eval "$(register-python-argcomplete nmpm)"
A --config that is not a file in the working directory is looked up among the shipped ones:
{configs}.
"""


def usage() -> str:
    """The top-level help."""
    import shutil
    import textwrap

    from nmpm._support.shipped import config_names

    width = max(40, shutil.get_terminal_size().columns)
    lines = [
        textwrap.fill(summary, width, initial_indent=f"  {name:<10} ", subsequent_indent=" " * 13)
        for name, summary in summaries().items()
    ]
    configs = textwrap.fill(
        ", ".join(config_names()), width, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False
    )
    return USAGE.format(commands="\n".join(lines), configs=configs)


def summaries() -> dict[str, str]:
    """What each command does, in a sentence; of one that cannot be imported, why."""
    lines = dict[str, str]()
    for name in COMMANDS:
        try:
            lines[name] = summary(COMMANDS[name])
        except NmpmError as error:
            lines[name] = str(error)
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; errors that a user can correct, those of the file system too, are printed without a traceback.

    Returns:
        The exit status: 0 for success, 1 for an error, 2 for a wrong call, 3 for a training that has diverged, 130 for
        an interruption.
    """
    with unfailing_output():
        return _main(list(sys.argv[1:] if arguments is None else arguments))


def _main(words: list[str]) -> int:
    limit_spinning()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what a line may go on with
        from nmpm.cli.completion import complete

        complete(COMMANDS, summaries)
        return 0
    words = [expand_home(word) for word in words]
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return 0 if words else 2
    if words[0] == "--version":
        sys.stdout.write(f"nmpm {__version__}\n")
        return 0
    if words[0] not in COMMANDS:
        near = get_close_matches(words[0], list(COMMANDS), n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}."
        sys.stderr.write(f"nmpm: there is no command {words[0]!r}; {hint} See nmpm --help.\n")
        return 2
    try:
        with plain_warnings():
            return run_command(COMMANDS[words[0]], f"nmpm {words[0]}", words[1:]) or 0
    except NmpmError as error:
        sys.stderr.write(f"nmpm {words[0]}: {error}\n")
        return error.exit_status
    except OSError as error:
        if error.strerror is None:
            raise
        file = "" if error.filename is None else f"{error.filename}: "
        sys.stderr.write(f"nmpm {words[0]}: {file}{error.strerror.lower()}.\n")
        return 1
    except KeyboardInterrupt as interrupt:
        line = "\r\x1b[K" if sys.stderr.isatty() else ""  # terminals show ^C there
        sys.stderr.write(f"{line}nmpm {words[0]}: {str(interrupt) or 'interrupted.'}\n")
        return 130


def expand_home(word: str) -> str:
    """A word of the command line, or a text of a configuration, with the home folder for a `~` that begins its path.

    Shells do so only where a word begins with it, not in --out=~/r.h5.
    """
    option, path = re.fullmatch(r"(--?[\w.]+=)?(.*)", word, re.DOTALL).groups("")  # type: ignore[union-attr]  # (matches all)
    return option + os.path.expanduser(path) if re.match(r"~\w*(/|$)", path) else word
