"""`nmpm zoo list | card NAME | match DATA | add RUN NAME | verify NAME | refresh NAME | push NAME ID | pull ID`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from nmpm._support.messages import one_line
from nmpm.cli import zoo_match
from nmpm.cli.options import CommandParser, add_device_option, check_device, check_model

_ROOT = "folder of another zoo (default: your own, NMPM_HOME/zoo or ~/.cache/nmpm/zoo, and the shipped one)"
_MODEL = "name, an entry's folder, or owner/repository@revision of the hub"

_EXAMPLES = """\
examples:
  nmpm zoo list                            names, states, errors and data
  nmpm zoo card goop                       errors, times, training and known failures of one
  nmpm zoo match grains                    which model to use, or to start from, for your own data
  nmpm zoo verify goop                     are the card's figures true here?
  nmpm zoo add runs/goop goop/mine --about "goop with a longer training"
  nmpm zoo push goop/mine me/goop          upload it, for nmpm zoo pull me/goop@main
"""


def run(words: list[str]) -> int | None:
    """Run a zoo command, e.g. ["zoo", "list"]; the exit status."""
    parser = _parser()
    if not words[1:]:
        parser.print_help(sys.stderr)
        return 2
    options = parser.parse_args(words[1:])
    action: Callable[[argparse.Namespace], int | None] = options.action
    return action(options)


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(prog="nmpm zoo", description="The pretrained models.", epilog=_EXAMPLES)
    parser.add_argument("--root", type=Path, help=_ROOT)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add_command(action: Callable[[argparse.Namespace], int | None], about: str) -> argparse.ArgumentParser:
        name = action.__name__.removeprefix("_")
        command = commands.add_parser(name, help=about, description=f"{about[:1].upper()}{about[1:]}.")
        command.set_defaults(action=action)
        command.add_argument("--root", type=Path, default=argparse.SUPPRESS, help=_ROOT)
        return command

    add_command(_list, "names, data and full-rollout errors of the models")
    card = add_command(_card, "errors, times, training and known failures of one model, and what computes it here")
    card.add_argument("name", help=_MODEL)
    card.add_argument("--yaml", action="store_true", help="everything known of it, for programs")
    zoo_match.add_arguments(add_command(zoo_match.match, zoo_match.ABOUT))
    add = add_command(_add, "make an entry of your own zoo, or of --root, from a finished run")
    add.add_argument("run", type=Path, help="the run's folder, e.g. runs/goop")
    add.add_argument("name", help="name of the new model, e.g. goop/mine")
    add.add_argument("--about", default="", help="description of the data and their origin, for the card")
    verify = add_command(_verify, "measure the figures of cards again; 1 if one is not confirmed")
    verify.add_argument("name", nargs="?", help=f"{_MODEL} (default: every model)")
    verify.add_argument("--full", action="store_true", help="all test scenes to their end (default: a few, 100 frames)")
    verify.add_argument("--data", type=Path, metavar="FOLDER", help="test data, of models of recorded data")
    add_device_option(verify)
    refresh = add_command(_refresh, "write READMEs, charts and the table of --root's models again")
    refresh.add_argument("name", nargs="?", help="name of your own, or an entry's folder (default: every model)")
    refresh.add_argument(
        "--measure",
        nargs="+",
        default=[],
        metavar="WHAT",
        help="for the cards: speed (on this machine), quality (earth mover's distance, energy, shape, worst scene),"
        " ensemble (scores of eight members), twin and floor (the simulator beside itself), trust (by valid scenes),"
        " stress; invariants: the stress tests without the simulator, where its scenes would take hours",
    )
    refresh.add_argument("--data", type=Path, metavar="FOLDER", help="NAME's data; spares simulating its scenes")
    refresh.add_argument(
        "--failures", metavar="TEXT", help='what is wrong in NAME\'s pictures, for its card ("": nothing is known)'
    )
    add_device_option(refresh, "where the speed is measured: ")
    push = add_command(_push, "upload a model to the Hugging Face hub")
    push.add_argument("name", help=_MODEL)
    push.add_argument("repository", help="owner/repository, created if missing")
    push.add_argument("--private", action="store_true", help="refuse a public repository; make a new one private")
    pull = add_command(_pull, "download a model of the Hugging Face hub")
    pull.add_argument("id", help="owner/repository@revision; a commit always means the same files")
    pull.add_argument("name", nargs="?", help="name of a new entry of your own zoo, or of --root (default: none)")
    return parser


def _list(options: argparse.Namespace) -> None:
    from nmpm._support.shipped import user_zoo
    from nmpm.errors import ZooError
    from nmpm.evaluation.figures import with_unit
    from nmpm.zoo.card import lifecycle, stated_error
    from nmpm.zoo.registry import Zoo

    for name in Zoo.list(options.root):
        own = "yours" if options.root is None and Zoo.folder(name).is_relative_to(user_zoo()) else ""
        try:
            card = Zoo.card(name, options.root)
            mse, dataset = stated_error(card), one_line(card.get("dataset", "data not stated"))
            error_text = "not measured" if mse is None else with_unit(mse)
            state, text = lifecycle(card), f"full-rollout MSE {error_text}   {dataset}"
        except ZooError as error:
            state, text = "", str(error)
        sys.stdout.write(f"{name:<20} {own:<6} {state:<10} {text}\n")


def _card(options: argparse.Namespace) -> None:
    from nmpm._support.bounded_files import to_yaml
    from nmpm.zoo.entry_files import read_card
    from nmpm.zoo.registry import find_entry

    card = read_card(find_entry(options.name, options.root))
    if options.yaml:
        sys.stdout.write(to_yaml(card))
        return
    from nmpm.zoo.pages import complete_card, entry_page  # imports torch

    with complete_card(options.name):
        text = entry_page(card)
    text = f"{text.rstrip()}\n\n## What runs here\n\n```text\n{_explain(options.name, options.root)}\n```\n"
    if not sys.stdout.isatty():
        sys.stdout.write(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))


def _explain(name: str, root: Path | None) -> str:
    """What computes a model on this machine's CPU; why it cannot be loaded, if so."""
    from nmpm.errors import NmpmError
    from nmpm.zoo.registry import load_model

    try:
        return load_model(name, root=root).emulator.explain()
    except NmpmError as error:
        return f"The model cannot be loaded: {error}"


def _add(options: argparse.Namespace) -> None:
    from nmpm.zoo.publish import add

    folder = add(options.run, options.name, options.root, options.about)
    sys.stdout.write(f"added {folder}\n")


def _verify(options: argparse.Namespace) -> int:
    """Verify a model, which must be possible; or all, of which those of recorded data may be left out.

    Of all, a damaged one counts as a figure that is not confirmed.
    """
    from nmpm.errors import ConfigError, NmpmError
    from nmpm.zoo.registry import Zoo, find_entry

    _check_one("--data is the folder of one model's data", options.data, options.name)
    if options.name is not None:
        check_model(options.name, options.root)
    check_device(options.device)
    from nmpm.zoo.verification import verify_entry  # imports torch

    failed, left_out = 0, []
    for name in Zoo.list(options.root) if options.name is None else [options.name]:
        sys.stdout.write(f"{name}\n")
        try:
            for check in verify_entry(find_entry(name, options.root), options.full, options.data, options.device):
                sys.stdout.write(f"  {check}\n")
                failed += not check.passed
        except ConfigError as error:
            if options.name is not None:
                raise
            sys.stdout.write(f"  not verified: {error}\n")
            left_out.append(name)
        except NmpmError as error:
            if options.name is not None:
                raise
            sys.stdout.write(f"  FAIL  {error}\n")
            failed += 1
    sys.stdout.write(f"{failed} figures are not confirmed." if failed else "All that was measured is confirmed.")
    sys.stdout.write(f" Not verified: {', '.join(left_out)}.\n" if left_out else "\n")
    return 1 if failed else 0


def _refresh(options: argparse.Namespace) -> None:
    from nmpm._support.shipped import user_zoo
    from nmpm.zoo.registry import Zoo

    _check_one("--data is the folder of one model's data", options.data, options.name)
    _check_one("--failures is about one model", options.failures, options.name)
    root = user_zoo() if options.root is None else options.root
    names = Zoo.list(root) if options.name is None else [options.name]
    folders = [_find_writable(name, options.root) for name in names]
    check_device(options.device)
    from nmpm.zoo.refresh import refresh, write_index  # imports torch

    for folder in folders:
        refresh(folder, options.measure, options.data, options.failures, options.device)
        sys.stdout.write(f"wrote {folder}\n")
    if all(folder.resolve().is_relative_to(root.resolve()) for folder in folders):
        sys.stdout.write(f"wrote {write_index(root)}\n")


def _check_one(option: str, value: object, name: str | None) -> None:
    """Make sure that an option about one model comes with its name."""
    from nmpm.errors import ConfigError

    if value is not None and name is None:
        raise ConfigError(f"{option}: give the model's NAME too.")


def _find_writable(model: str, root: Path | None) -> Path:
    """The folder of an entry to refresh: of that name in the user's own zoo or in `root`, or at that path.

    Raises:
        ConfigError: if it is on the hub.
        ZooError: if there is none.
    """
    from nmpm._support.shipped import user_zoo
    from nmpm.errors import ConfigError
    from nmpm.zoo.hub import HubId
    from nmpm.zoo.registry import Zoo, find_entry

    if root is not None:
        return Zoo.folder(model, root)
    if model in (Zoo.list(user_zoo()) if user_zoo().is_dir() else []):
        return Zoo.folder(model, user_zoo())
    if Path(model).is_dir():
        return find_entry(Path(model))
    if HubId.parse(model) is not None:
        raise ConfigError(f"{model} is on the hub: `nmpm zoo pull {model} NAME` makes an entry of it; refresh that.")
    return Zoo.folder(model, user_zoo())


def _push(options: argparse.Namespace) -> None:
    from nmpm.zoo.hub import push
    from nmpm.zoo.registry import find_entry

    commit = push(find_entry(options.name, options.root), options.repository, options.private)
    sys.stdout.write(f"pushed {commit}; load it by that id.\n")


def _pull(options: argparse.Namespace) -> None:
    from nmpm.errors import ConfigError
    from nmpm.zoo.hub import HubId, download, pull

    identifier = HubId.parse(options.id)
    if identifier is None:
        raise ConfigError(f"{options.id} is not owner/repository@revision; the revision may be a commit, or main.")
    from nmpm.zoo.entries import load_entry  # imports torch
    from nmpm.zoo.publish import new_entry_folder

    if options.name is None:
        folder = download(identifier)
        load_entry(folder)
    else:
        folder = pull(identifier, new_entry_folder(options.name, options.root), options.name)
    sys.stdout.write(f"{identifier} is in {folder}\n")
