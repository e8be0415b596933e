"""Write `trade_tables.md`: all that `nmpm trade` has measured for the charts of `benchmarks/trade`.

python benchmarks/trade_tables.py                       the page, of all of benchmarks/trade/*/trade.csv
python benchmarks/trade_tables.py trade/mine/trade.csv --page mine.md

A table of each dataset, and each model beside the simulator at equal time and at equal error (`beside_simulator.py`).
Nothing is measured here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from beside_simulator import TRADE, find_rivals, read_rows, short_name, table_lines
from timing import make_parser

from nmpm._support.atomic import atomic_write
from nmpm._support.digests import short_digest
from nmpm.evaluation.trade.models import OTHER_SCENES
from nmpm.zoo import Zoo

PAGE = Path(__file__).parent / "trade_tables.md"
INTRODUCTION = """\
# Tables of the trade

Written by `benchmarks/trade_tables.py` from the tables that `nmpm trade` wrote; [time and error](trade.md) says what
they show. Milliseconds and time, relative to the simulator as shipped, are per frame and scene, medians of the rounds;
MSE and EMD (earth mover's distance of the last frame, of the domain's side) × 10⁻³; *field* is the share of the
material that lies in another cell, of 3 particle spacings; height and kinetic energy are deviations. The bootstrap
interval over scenes is in brackets. Choices of the Pareto set are bold; unstable ones count for nothing, and their
errors are left out. *Weights* are the first digits of their SHA-256 (`nmpm._support.digests`), where the table has
them. All scenes are simulated by nmpm.
"""
RIVALS = """\
## Models beside the simulator

Each model, one scene at a time, beside the most accurate stable setting of the simulator that is no slower, and beside
the cheapest one that is no less accurate (`benchmarks/beside_simulator.py`; MSE × 10⁻³ of full rollouts; bold: no
setting is both as fast and as accurate):
"""
FORMS: Mapping[str, tuple[str, float, str]] = {
    "mse@100": ("MSE@100", 1e3, ""),
    "mse": ("MSE", 1e3, ""),
    "emd": ("EMD", 1e3, ""),
    "field": ("field", 1.0, ""),
    "height": ("height", 1e2, "%"),
    "kinetic": ("kinetic", 1e2, "%"),
}
"""Heading, factor and unit of each measure that is shown."""


@dataclass(frozen=True)
class Choice:
    """The rows of one choice.

    Args:
        row: Any of them, for what they have in common.
        errors: Value and bounds of each measure, as written.
    """

    row: Mapping[str, str]
    errors: Mapping[str, tuple[str, str, str]]

    @property
    def milliseconds(self) -> float:
        """Per frame and scene."""
        return float(self.row["ms_per_frame"])


def group_choices(rows: Iterable[Mapping[str, str]]) -> list[Choice]:
    """The choices of a table's rows, in order of their time."""
    found: dict[str, list[Mapping[str, str]]] = {}
    for row in rows:
        found.setdefault(row["name"], []).append(row)
    choices = [
        Choice(own[0], {row["error"]: (row["value"], row["low"], row["high"]) for row in own if row["value"]})
        for own in found.values()
    ]
    return sorted(choices, key=lambda choice: choice.milliseconds)


@cache
def zoo_digest(name: str) -> str | None:
    """Digest of the weights of the zoo's model of that name now; None if there is none."""
    return short_digest(Zoo.load(name).emulator.state_dict()) if name in Zoo.list() else None


def weights_line(choices: Iterable[Choice], now: Callable[[str], str | None] = zoo_digest) -> str:
    """Which weights were measured, and whether the zoo still has them; empty where the table does not say.

    Args:
        choices: Of a table.
        now: Digest of the zoo's weights by a model's name, None for one that it does not have.
    """
    rows = [choice.row for choice in choices]
    found = {row["model"].removesuffix(OTHER_SCENES): row["weights"] for row in rows if row.get("weights")}
    parts = [
        f"{model} {digest}" + ("" if now(model) in (None, digest) else " (the zoo has others by now)")
        for model, digest in sorted(found.items())
    ]
    return f"Weights: {', '.join(parts)}." if parts else ""


def section_lines(choices: Sequence[Choice]) -> Iterator[str]:
    """Heading and table of a dataset."""
    first = choices[0].row
    shown = [name for name in FORMS if any(name in choice.errors for choice in choices)]
    yield f"## {first['dataset']}\n"
    yield (
        f"{first['scenes']} test scenes, {first['particles']} particles (median); {first['hardware']}, "
        f"{first['threads']} thread, {first['clock']}.\n"
        f"[Picture](trade/{first['dataset']}/trade.png).\n"
    )
    if weights := weights_line(choices):
        yield f"{weights}\n"
    yield " | ".join(["| choice", "ms", "time", *(FORMS[name][0] for name in shown)]) + " |"
    yield "|---|" + "---:|" * (2 + len(shown))
    for choice in choices:
        yield _line(choice, shown)
    yield ""


def _line(choice: Choice, shown: Iterable[str]) -> str:
    row, name = choice.row, short_name(choice.row)
    if row["pareto"] == "True":
        name = f"**{name}**"
    stable = row["stable"] == "True"
    if not stable:
        name += f": unstable in {row['failed_scenes']} of {row['scenes']} scenes"
    cells = [
        _error(measure, *choice.errors[measure]) if stable and measure in choice.errors else "" for measure in shown
    ]
    return (
        " | ".join([f"| {name}", _digits(choice.milliseconds), _digits(float(row["ratio_to_reference"]), 2), *cells])
        + " |"
    )


def _error(measure: str, value: str, low: str, high: str) -> str:
    _, factor, unit = FORMS[measure]
    if measure != "mse" or not low:
        return _digits(factor * float(value), 2) + unit
    return f"{_digits(factor * float(value))} ({_digits(factor * float(low))} – {_digits(factor * float(high))})"


def _digits(value: float, count: int = 3) -> str:
    """Significant digits, without an exponent for large values."""
    text = f"{value:.{count}g}"
    return f"{value:.0f}" if "e+" in text else text


def page_text(paths: Sequence[Path]) -> str:
    """The page of these tables."""
    tables = [read_rows(path) for path in paths]
    sections = [line for rows in tables for line in section_lines(group_choices(rows))]
    rivals = [one for rows in tables for one in find_rivals(rows)]
    return "\n".join([INTRODUCTION, *sections, RIVALS, *table_lines(rivals)]) + "\n"


def main(words: Sequence[str] | None = None) -> None:
    """Write the page."""
    parser = make_parser(__doc__)
    parser.add_argument("tables", nargs="*", type=Path, default=sorted(TRADE.glob("*/trade.csv")), help="trade.csv")
    parser.add_argument("--page", type=Path, default=PAGE, help="where to write (default: benchmarks/trade_tables.md)")
    chosen = parser.parse_args(words)
    with atomic_write(chosen.page) as part:
        part.write_text(page_text(chosen.tables), encoding="utf-8")
    sys.stdout.write(f"wrote {chosen.page}\n")


if __name__ == "__main__":
    main()
