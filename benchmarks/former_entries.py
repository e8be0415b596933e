"""The zoo's models beside their former entries on the same test scenes: a Markdown table. Nothing is measured here.

python benchmarks/former_entries.py sandramps goop            beside the entries of the last commit
python benchmarks/former_entries.py sandramps --before v0.1   beside those of any revision that git knows

Errors (MSE × 10⁻³ of so many frames), former → now, as the cards state them; in brackets the ratio with its 95%
interval, paired over the scenes: both models are resampled alike. It does not contain the scatter of trainings.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import yaml
from timing import make_parser

from nmpm.data.simulation_request import same_trajectories
from nmpm.errors import ConfigError
from nmpm.evaluation.bootstrap import ratio_interval
from nmpm.zoo.entries import CARD, read_card

ZOO = Path(__file__).parent.parent / "zoo"
FIGURES = {"mse@32": "at 32", "mse@100": "at 100", "mse": "full"}
"""What the table shows, with its headings."""


def former_card(name: str, revision: str) -> dict[str, Any]:
    """The card of an entry in a revision of this repository.

    Raises:
        ConfigError: if git has none.
    """
    path = f"{revision}:zoo/{name}/{CARD}"
    words = ["git", "show", "--end-of-options", path]
    found = subprocess.run(words, cwd=ZOO.parent, capture_output=True, text=True, check=False)
    if found.returncode:
        raise ConfigError(f"{path}: {found.stderr.strip()}")
    card: dict[str, Any] = yaml.safe_load(found.stdout)
    return card


def table_lines(pairs: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]]) -> Iterator[str]:
    """The table of former and present cards, by name.

    Raises:
        ConfigError: if a model's test scenes have changed.
    """
    yield f"| | hours before | hours now | {' | '.join(FIGURES.values())} |"
    yield "|---|---:|---:|" + "---|" * len(FIGURES)
    for name, (before, now) in pairs.items():
        if not same_trajectories(before.get("simulation", {}), now.get("simulation", {})):
            raise ConfigError(f"{name}: the simulated test scenes are others than before.")
        former, present = before["per_trajectory"], now["per_trajectory"]
        if len(former) != len(present):
            raise ConfigError(f"{name}: {len(former)} test scenes before, {len(present)} now: they cannot be paired.")
        hours = [f"{card['training']['seconds'] / 3600:.1f}" for card in (before, now)]
        cells = [_cell(former, present, figure) for figure in FIGURES]
        yield f"| `{name}` | {' | '.join([*hours, *cells])} |"


def _cell(before: Sequence[Mapping[str, float]], now: Sequence[Mapping[str, float]], figure: str) -> str:
    former, present = ([scene[figure] for scene in scenes] for scenes in (before, now))
    ratio, low, high = ratio_interval(present, former)
    return f"{1e3 * mean(former):.3g} → {1e3 * mean(present):.3g} ({ratio:.2f}: {low:.2f}–{high:.2f})"


def main(words: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("names", nargs="+", metavar="NAME", help="models of the zoo")
    parser.add_argument("--before", default="HEAD", metavar="REVISION", help="of the former entries (default: HEAD)")
    chosen = parser.parse_args(words)
    pairs = {name: (former_card(name, chosen.before), read_card(ZOO / name)) for name in chosen.names}
    for line in table_lines(pairs):
        sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main()
