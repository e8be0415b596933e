"""Rewrite an entry's card with what is measured of it, and the README and chart that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from filelock import BaseFileLock, FileLock

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_plain, to_yaml
from nmpm._support.shipped import user_home
from nmpm.errors import DataError, ZooError
from nmpm.zoo.card import CARD, read_card
from nmpm.zoo.entries import load_entry
from nmpm.zoo.measures.ensemble import ensemble_facts
from nmpm.zoo.measures.model import invariant_facts, quality_facts, stress_facts, trust_facts
from nmpm.zoo.measures.simulator import floor_facts, twin_facts
from nmpm.zoo.measures.speed import speed_facts
from nmpm.zoo.pages import CHART, complete_card, draw_chart, entry_page, index_page
from nmpm.zoo.pretrained import Pretrained
from nmpm.zoo.registry import Zoo
from nmpm.zoo.speed_table import BETWEEN, replace_table

MEASURES: Mapping[str, Callable[[Pretrained, Path, Path | None], dict[str, Any]]] = MappingProxyType(
    {
        "speed": lambda model, folder, _: speed_facts(model, folder),
        "quality": quality_facts,
        "ensemble": lambda model, _, data: ensemble_facts(model, data),
        "twin": lambda model, _, data: twin_facts(model, data),
        "floor": lambda model, _, data: floor_facts(model, data),
        "trust": lambda model, _, data: trust_facts(model, data),
        "stress": lambda model, *_: stress_facts(model),
        "invariants": lambda model, *_: invariant_facts(model),
    }
)
"""What `nmpm zoo refresh --measure` adds to cards, of a model, its entry's folder and the folder of its data or None.

Each gives the keys of the card that it replaces, and may write pictures into the entry's folder.
"""


def writing() -> BaseFileLock:
    """A lock that lets one process of this user at a time write to entries."""
    user_home().mkdir(parents=True, exist_ok=True)
    return FileLock(user_home() / "zoo.lock")


def refresh(
    folder: Path,
    measures: Sequence[str] = (),
    data: Path | None = None,
    failures: str | None = None,
    device: torch.device | str = "cpu",
) -> None:
    """Measure what is asked for, and rewrite an entry's card, README and chart.

    The golden rollout is kept, as replacing it would hide a change of the results. The card is written after each
    measure, with what others wrote to it meanwhile.

    Args:
        folder: Of the entry.
        measures: Of `MEASURES`.
        data: Folder of the dataset, which spares the simulation of its scenes; needed for recorded data.
        failures: What the entry's pictures show to be wrong in its rollouts, in sentences, for the card; empty to state
            nothing, None to leave what the card states.
        device: Where the speed is measured, as for `Zoo.load`; everything else is measured on the CPU.

    Raises:
        ZooError: if a file is missing or damaged, a measure is unknown, or the weights are replaced meanwhile.
        ConfigError: if what is to be measured needs a simulator, data or a device that are not there.
    """
    unknown = sorted(set(measures) - set(MEASURES))
    if unknown:
        raise ZooError(f"--measure {' '.join(unknown)}: what can be measured is {', '.join(MEASURES)}.")
    model = load_entry(folder)
    weights = str(model.card["sha256"])
    add_facts(folder, weights, {} if failures is None else {"failures": " ".join(failures.split())})
    for name in measures:
        measured = model.to(device) if name == "speed" else model
        add_facts(folder, weights, MEASURES[name](measured, folder, data))


def add_facts(folder: Path, weights: str, facts: Mapping[str, Any]) -> None:
    """Write facts, keys of the card, to an entry's card, beside what others wrote to it meanwhile.

    Keys with an empty text are removed. Raises ZooError if the entry has other weights, of this SHA-256, by now.
    """
    with writing():
        card = read_card(folder)
        if card.get("sha256") != weights:
            measured = ", ".join(facts) or "its card"
            raise ZooError(f"{folder}: its weights were replaced while {measured} was measured; measure it again.")
        write_card(folder, {key: value for key, value in {**card, **facts}.items() if value != "" or key == "about"})


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write an entry's card, and the chart and README that follow from it.

    Raises:
        ZooError: if they cannot be made, as something is missing; nothing is written.
    """
    try:
        check_plain(card, folder / CARD)
    except DataError as error:
        raise ZooError(str(error)) from error
    with complete_card(card.get("name", folder)):
        chart = draw_chart(folder, card["name"])
        page = entry_page(card, [path.name for path in folder.iterdir()] + [CHART] * (chart is not None))
    _write(folder / CARD, to_yaml(card))
    if chart is not None:
        with atomic_write(folder / CHART) as part:
            chart.savefig(part, format="png")
    _write(folder / "README.md", page)


def write_index(root: Path) -> Path:
    """Write the page of a zoo's models, `README.md` in its folder, and the table of speed-ups in the one beside it."""
    names, beside = Zoo.list(root), root.parent / "README.md"
    _write(root / "README.md", index_page(root, names))
    if beside.is_file() and BETWEEN.search(text := beside.read_text(encoding="utf-8")):
        _write(beside, replace_table(text, {name: Zoo.card(name, root) for name in names}, f"{root.name}/"))
    return root / "README.md"


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
