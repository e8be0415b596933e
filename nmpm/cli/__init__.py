"""The command line. `nmpm --help` answers at once: what a command needs is imported when the command runs."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module

from nmpm._support.messages import plain_warnings, unfailing_output
from nmpm._support.threads import limit_spinning
from nmpm._support.version import __version__
from nmpm.errors import NmpmError

COMMANDS = {
    "fit": ("nmpm.cli.training", "Train an emulator, then test the best checkpoint once."),
    "validate": ("nmpm.cli.training", "Roll a checkpoint out over the valid split."),
    "test": ("nmpm.cli.training", "Roll a checkpoint out over the test split; write table, picture and animation."),
    "predict": ("nmpm.cli.training", "Roll a checkpoint out over the test split and write the trajectories."),
    "simulate": ("nmpm.cli.simulate", "Simulate a dataset of one of the shipped scenes, or of one's own."),
    "convert": ("nmpm.cli.convert", "Convert a dataset of another format to the native layout."),
    "init": ("nmpm.cli.init", "Write a configuration for a dataset, chosen by what its trajectories show."),
    "inspect": ("nmpm.cli.inspect", "Summarise a dataset on one screen, with anything odd about it."),
    "zoo": ("nmpm.cli.zoo", "List the pretrained models, find one for your data, or add a finished run."),
    "demo": ("nmpm.cli.demo", "Show a model beside the simulator that it learned from: times, error, a page."),
    "rollout": ("nmpm.cli.rollout", "Roll a pretrained model out and write the trajectories."),
    "stress": ("nmpm.cli.stress", "Test a model at the extremes: pass or fail, with measured margins."),
    "compare": ("nmpm.cli.compare", "Compare models on scenes that need not be their own."),
    "trade": ("nmpm.cli.trade", "Measure time and errors of models, the simulator and trivial predictors."),
    "export": ("nmpm.cli.export", "Write a model as a file that runs without nmpm: ONNX, or AOTInductor's."),
    "render": ("nmpm.cli.render", "Draw trajectories as PNG and GIF or MP4."),
    "play": ("nmpm.cli.play", "Throw and pour in a browser, while a pretrained model predicts."),
    "view": ("nmpm.cli.view", "Write a page that plays trajectories in a browser."),
    "doctor": ("nmpm.cli.doctor", "Report on the installation and test it, for help with problems."),
}

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
        for name, (_, summary) in COMMANDS.items()
    ]
    configs = textwrap.fill(
        ", ".join(config_names()), width, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False
    )
    return USAGE.format(commands="\n".join(lines), configs=configs)


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

        complete()
        return 0
    words = [expand_home(word) for word in words]
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return 0 if words else 2
    if words[0] == "--version":
        sys.stdout.write(f"nmpm {__version__}\n")
        return 0
    if words[0] not in COMMANDS:
        near = get_close_matches(words[0], COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}."
        sys.stderr.write(f"nmpm: there is no command {words[0]!r}; {hint} See nmpm --help.\n")
        return 2
    try:
        with plain_warnings():
            command: Callable[[list[str]], int | None] = import_module(COMMANDS[words[0]][0]).run
            return command(words) or 0
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
