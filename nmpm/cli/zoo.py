"""`nmpm zoo list | card NAME | add RUN NAME`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_ROOT = "folder of another zoo (default: your own, NMPM_HOME/zoo or ~/.cache/nmpm/zoo, and the shipped one)"


def run(words: list[str]) -> None:
    """Run a zoo command, e.g. ["zoo", "list"]."""
    parser = argparse.ArgumentParser(prog="nmpm zoo", description="The pretrained models.")
    parser.add_argument("--root", type=Path, help=_ROOT)
    commands = parser.add_subparsers(dest="command", required=True)
    listing = commands.add_parser("list", help="names, data and full-rollout errors of the models")
    card = commands.add_parser("card", help="everything known of one model")
    card.add_argument("name")
    add = commands.add_parser("add", help="make an entry of your own zoo, or of --root, from a finished run")
    add.add_argument("run", type=Path, help="the run's folder, e.g. runs/goop")
    add.add_argument("name", help="name of the new model, e.g. goop/mine")
    add.add_argument("--about", default="", help="description of the data and their origin, for the card")
    for command in (listing, card, add):
        command.add_argument("--root", type=Path, default=argparse.SUPPRESS, help=_ROOT)
    chosen = parser.parse_args(words[1:])
    {"list": _list, "card": _card, "add": _add}[chosen.command](chosen)


def _list(chosen: argparse.Namespace) -> None:
    from nmpm._support.shipped import user_zoo
    from nmpm.errors import ZooError
    from nmpm.zoo.registry import Zoo

    for name in Zoo.list(chosen.root):
        own = "yours" if chosen.root is None and Zoo.folder(name).is_relative_to(user_zoo()) else ""
        try:
            text = _summary(Zoo.card(name, chosen.root))
        except ZooError as error:
            text = str(error)
        sys.stdout.write(f"{name:<20} {own:<6} {text}\n")


def _summary(card: Mapping[str, Any]) -> str:
    test = card.get("test")
    mse = test.get("mse") if isinstance(test, Mapping) else None
    error = f"{1e3 * mse:.3g} ×10⁻³" if isinstance(mse, int | float) else "not measured"
    return f"full-rollout MSE {error}   {card.get('dataset', 'data not stated')}"


def _card(chosen: argparse.Namespace) -> None:
    import yaml

    from nmpm.zoo.registry import Zoo

    sys.stdout.write(yaml.safe_dump(Zoo.card(chosen.name, chosen.root), sort_keys=False, allow_unicode=True))


def _add(chosen: argparse.Namespace) -> None:
    from nmpm.zoo.publish import add

    folder = add(chosen.run, chosen.name, chosen.root, chosen.about)
    sys.stdout.write(f"added {folder}\n")
