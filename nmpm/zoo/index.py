"""Writes the table of a zoo's models, and rewrites cards, READMEs and charts of its entries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from nmpm._support.atomic import atomic_write
from nmpm._support.bounded_files import check_characters, to_yaml
from nmpm._support.messages import one_line
from nmpm.errors import DataError, ZooError
from nmpm.zoo.cards import MALFORMED, intervals, readme, twin_ratio
from nmpm.zoo.charts import CHART, draw_chart, save_chart
from nmpm.zoo.entries import CARD, load_entry, read_card, writing
from nmpm.zoo.golden import golden_rollout
from nmpm.zoo.lifecycle import CARD_FORMAT, lifecycle
from nmpm.zoo.measures import MEASURES
from nmpm.zoo.registry import Zoo
from nmpm.zoo.scene_table import scene_row, scene_table

HEAD = """\
# The zoo

Pretrained models, one folder each: `card.yaml` (what it is and how good), `config.yaml` (how it is built),
`model.safetensors` (weights and statistics) and a README. `nmpm zoo list` lists them, `nmpm zoo verify` measures them
again, `nmpm zoo add RUN NAME` adds one and `python zoo/train.py` trains them all. `nmpm zoo refresh` writes this table.

Errors are full-rollout MSE ×10⁻³ in domain length², over test scenes, with the 95% interval of their mean; beside them
the goal of `queue.yaml`, a fixed target, and the better of two trivial predictors, nothing moves and free fall. *At
100*: the error over the first 100 frames. *Twins*: the error divided by that of the simulator's *twin*, its own result
with other time steps (mostly half as many): at 1, a model is as accurate as the data themselves. Milliseconds are per
frame of one scene. `docs/concepts.md` explains the terms.
"""
COLUMNS = ("model", "state", "data", "MSE", "95%", "goal", "at 100", "twins", "trivial", "trained", "ms per frame")


def write_index(root: Path) -> Path:
    """Write the table of a zoo's models, `README.md` in its folder; entries with a damaged card are left out."""
    with writing(root / CARD):
        return _write_index(root)


def _write_index(root: Path) -> Path:
    rows, scenes = [], []
    for name in Zoo.list(root):
        try:
            card = Zoo.card(name, root)
            row, scene = _row(name, card), scene_row(name, root / name, card)
        except (ZooError, *MALFORMED):  # a DataError is a ValueError
            continue
        rows.append(row)
        scenes.append(scene)
    table = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}", *rows]
    path = root / "README.md"
    with atomic_write(path) as part:
        part.write_text("\n".join([HEAD, *table, "", *scene_table(scenes)]) + "\n", encoding="utf-8")
    return path


def refresh(
    folder: Path,
    measures: Sequence[str] = (),
    data: Path | None = None,
    failures: str | None = None,
    device: torch.device | str = "cpu",
) -> None:
    """Rewrite what is derived from an entry's card and weights: lifecycle, README and chart.

    A golden rollout is added where the card has none; an existing one is kept, as replacing it would hide a change
    of the results. The card is written after each measure, with what others wrote to it meanwhile.

    Args:
        folder: Of the entry.
        measures: What to measure for the card, of `nmpm.zoo.measures.MEASURES`.
        data: Folder of the dataset, which spares the simulation of the test scenes; needed for recorded data.
        failures: What the entry's pictures show to be wrong in its rollouts, in sentences, for the card; empty to state
            nothing, None to leave what the card states. New weights make a new card, without it: their pictures have
            to be looked at again.
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
    golden = {} if "golden" in model.card else {"golden": golden_rollout(model.emulator)}
    with writing(folder):
        card = read_card_of(folder, weights, "the golden rollout")
        card = {"format": CARD_FORMAT} | card | {"lifecycle": lifecycle(card)} | golden
        if failures is not None:
            card.pop("failures", None)
            card |= {"failures": " ".join(failures.split())} if failures.strip() else {}
        write_card(folder, card)
    for name in measures:
        measured = model.to(device) if name == "speed" else model
        add_facts(folder, weights, MEASURES[name](measured, folder, data))


def add_facts(folder: Path, weights: str, facts: Mapping[str, Any]) -> None:
    """Write facts about an entry's weights to its card, beside what others wrote to it meanwhile.

    Args:
        folder: Of the entry.
        weights: SHA-256 of the weights that the facts are about.
        facts: Keys of the card, with their values.

    Raises:
        ZooError: if the entry has other weights by now.
    """
    with writing(folder):
        write_card(folder, {**read_card_of(folder, weights, ", ".join(facts)), **facts})


def read_card_of(folder: Path, weights: str, measured: str) -> dict[str, Any]:
    """The card of an entry, if it still has the weights of this SHA-256, of which something was measured.

    Raises:
        ZooError: if it has others.
    """
    card = read_card(folder)
    if card.get("sha256") != weights:
        raise ZooError(f"{folder}: its weights were replaced while {measured} was measured; measure it again.")
    return card


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write an entry's card, and the chart and README that follow from it.

    Raises:
        ZooError: if they cannot be made, as something is missing; nothing is written.
    """
    try:
        check_characters(card, folder / CARD)
    except DataError as error:
        raise ZooError(str(error)) from error
    try:
        chart = draw_chart(folder, card)
        pictures = {path.name for path in folder.iterdir()} | ({CHART} if chart else set())
        text = readme(card, pictures)
    except MALFORMED as error:
        raise ZooError(
            f"{folder / CARD} or errors.csv beside it is not complete ({type(error).__name__}: {one_line(error)})."
            " `nmpm zoo card NAME --yaml` shows what the card has; `nmpm zoo add` writes a new one from the run."
        ) from error
    with atomic_write(folder / CARD) as part:
        part.write_text(to_yaml(card), encoding="utf-8")
    if chart is not None:
        save_chart(folder, chart)
    with atomic_write(folder / "README.md") as part:
        part.write_text(text, encoding="utf-8")


def _row(name: str, card: Mapping[str, Any]) -> str:
    test, training = card.get("test") or {}, card.get("training") or {}
    interval = intervals(card).get("mse")
    trivial = [test[key] for key in ("still/mse", "free_fall/mse") if key in test]
    cells = {
        "model": f"[{name}]({name}/README.md)",
        "state": lifecycle(card),
        "data": str(card.get("dataset", "")),
        "MSE": _thousandths(test.get("mse")),
        "95%": "" if interval is None else f"{_thousandths(interval[0])} – {_thousandths(interval[1])}",
        "goal": _thousandths(card.get("goal")),
        "at 100": _thousandths(test.get("mse@100")),
        "twins": twin_ratio(card, "mse"),
        "trivial": _thousandths(min(trivial, default=None)),
        "trained": f"{training['seconds'] / 3600:.1f} h" if "seconds" in training else "",
        "ms per frame": "; ".join(
            f"{entry['ms_per_frame']:.2g} ({entry['hardware']})" for entry in card.get("speed", [])
        ),
    }
    return f"| {' | '.join(cells[column] for column in COLUMNS)} |"


def _thousandths(value: float | None) -> str:
    return "" if value is None else f"{1e3 * value:.3g}"
