"""`nmpm zoo list | card NAME | add RUN NAME`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nmpm._support.shipped import shipped


def run(words: list[str]) -> None:
    """Run a zoo command, e.g. ["zoo", "list"]."""
    parser = argparse.ArgumentParser(prog="nmpm zoo", description="The pretrained models.")
    parser.add_argument("--root", type=Path, default=shipped("zoo"), help="the zoo's folder (default: the shipped one)")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="names, data and full-rollout errors of the models")
    card = commands.add_parser("card", help="everything known of one model")
    card.add_argument("name")
    add = commands.add_parser("add", help="make a zoo entry of a finished run")
    add.add_argument("run", type=Path, help="the run's folder, e.g. runs/goop")
    add.add_argument("name", help="what the model is to be called, e.g. goop or goop/small")
    add.add_argument("--about", default="", help="what the data are and where they come from, for the card")
    chosen = parser.parse_args(words[1:])
    {"list": _list, "card": _card, "add": _add}[chosen.command](chosen)


def _list(chosen: argparse.Namespace) -> None:
    from nmpm.zoo.registry import Zoo

    for name in Zoo.list(chosen.root):
        card = Zoo.card(name, chosen.root)
        error = 1e3 * card["test"]["mse"]
        sys.stdout.write(f"{name:<16} full-rollout MSE {error:.3g} ×10⁻³   {card['dataset']}\n")


def _card(chosen: argparse.Namespace) -> None:
    import yaml

    from nmpm.zoo.registry import Zoo

    sys.stdout.write(yaml.safe_dump(Zoo.card(chosen.name, chosen.root), sort_keys=False, allow_unicode=True))


def _add(chosen: argparse.Namespace) -> None:
    from nmpm.zoo.publish import add

    sys.stdout.write(f"added {add(chosen.run, chosen.name, chosen.root, chosen.about)}\n")
