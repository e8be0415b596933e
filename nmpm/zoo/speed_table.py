"""Tables of speed-ups: a frame by the model and by the simulator at equal error, on one machine each."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from nmpm.zoo.card import fastest_time, lifecycle

HEAD = (
    "| model | scene | simulator, ms per frame | model, ms per frame | times as fast |",
    "|---|---|---:|---:|---:|",
)
BETWEEN = re.compile(r"(<!-- speed-ups[^>]*-->\n).*?(<!-- end -->)", flags=re.DOTALL)
"""Marks around the table in a Markdown file."""


def speed_tables(cards: Mapping[str, Mapping[str, Any]], folder: str = "") -> dict[str, str]:
    """Tables in Markdown by hardware, that of most models first; of the cards by name that state a speed-up.

    Args:
        cards: Content of `card.yaml` by the entry's name.
        folder: Of the entries, as links are to have it, such as "zoo/".
    """
    groups: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for name, card in cards.items():
        trade, fastest = card.get("trade") or {}, fastest_time(card)
        if fastest is not None and "speed_up" in trade:
            groups[fastest["hardware"]].append((trade["speed_up"], _row(name, card, folder)))
    ordered = sorted(groups.items(), key=lambda group: -len(group[1]))
    return {hardware: "\n".join([*HEAD, *(row for _, row in sorted(rows)[::-1])]) for hardware, rows in ordered}


def replace_table(text: str, cards: Mapping[str, Mapping[str, Any]], folder: str) -> str:
    """A text with the table of the hardware of most models between its marks; unchanged without marks."""
    table = next(iter(speed_tables(cards, folder).values()), "")
    return BETWEEN.sub(lambda marks: f"{marks[1]}{table}\n{marks[2]}", text)


def _row(name: str, card: Mapping[str, Any], folder: str) -> str:
    times = [time["ms_per_frame"] for time in card["trade"]["times"]]
    simulator = card["trade"]["speed_up"] * min(times)
    cells = [
        f"[{name}]({folder}{name}/README.md)" + (" (preview)" if lifecycle(card) == "preview" else ""),
        _scene(card),
        _figure(simulator),
        _between(max(times), min(times)),
        _between(simulator / max(times), simulator / min(times)),
    ]
    return f"| {' | '.join(cells)} |"


def _scene(card: Mapping[str, Any]) -> str:
    """Such as `5,000 particles, SPH`."""
    solver = card["simulation"]["preset"]["solver"] if card.get("simulation") else ""
    method = "SPH" if "sph" in solver else "MPM" if "mpm" in solver else "recorded"
    return f"{card['particles']:,} particles, {method}"


def _between(one: float, other: float) -> str:
    return f"{_figure(one)} – {_figure(other)}"


def _figure(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:#.2g}"
