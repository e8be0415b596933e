"""Cards: the files of an entry and what follows from `card.yaml`; needs no torch."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import read_text, read_yaml
from nmpm._support.messages import one_line
from nmpm._support.plain_data import is_finite
from nmpm.errors import DataError, ZooError
from nmpm.evaluation.bootstrap import interval

CARD = "card.yaml"
FORMAT = 1
"""Version of the layout of `card.yaml` and of the files beside it."""
FACTOR = 4.0
"""How much lower than the better trivial predictor's a model's full-rollout MSE must be, to be more than a preview."""
SIMULATED = ", simulated by nmpm"
"""What follows a preset's name in the description of its dataset."""


def preset_of(card: Mapping[str, Any]) -> str | None:
    """Name of the simulator preset that made the data of a card; None for recorded or unknown data."""
    name, simulated, _ = str(card.get("dataset", "")).partition(SIMULATED)
    return name if simulated else None


def stated_error(card: Mapping[str, Any], name: str = "mse") -> float | None:
    """A figure of the test scenes that a card states; None where it states none that is finite."""
    test = card.get("test")
    value = test.get(name) if isinstance(test, Mapping) else None
    return float(value) if is_finite(value) else None


def stated_nudge(card: Mapping[str, Any]) -> float | None:
    """Cells by which starts of members are displaced, as calibrated; None where a card states no such number."""
    ensemble = card.get("ensemble")
    value = ensemble.get("nudge") if isinstance(ensemble, Mapping) else None
    return float(value) if is_finite(value) and value >= 0 else None


def stated_milliseconds(card: Mapping[str, Any]) -> dict[str, float]:
    """Milliseconds per frame by hardware, as a card states them; malformed ones are left out."""
    speed = card.get("speed")
    entries = [entry for entry in speed if isinstance(entry, Mapping)] if isinstance(speed, list) else []
    times = {str(entry.get("hardware")): entry.get("ms_per_frame") for entry in entries}
    return {name: float(time) for name, time in times.items() if is_finite(time) and time > 0}


def fastest_time(card: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The hardware, runtime and least time per frame that `nmpm trade` measured; None where it was not run."""
    times = (card.get("trade") or {}).get("times", [])
    return min(times, key=lambda time: time["ms_per_frame"], default=None)


def trivial_error(card: Mapping[str, Any]) -> float | None:
    """The full-rollout error of the better trivial predictor: nothing moves, or free fall."""
    errors = (stated_error(card, f"{kind}/mse") for kind in ("still", "free_fall"))
    return min((error for error in errors if error is not None), default=None)


def lifecycle(card: Mapping[str, Any]) -> str:
    """The state of a model: "active", or "preview".

    A preview's full-rollout error is not `FACTOR` times lower than a trivial predictor's, or not measured beside one.
    """
    mse, trivial = stated_error(card), trivial_error(card)
    return "active" if mse is not None and trivial is not None and FACTOR * mse <= trivial else "preview"


def intervals(rows: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """The 95% interval of each figure's mean over test scenes, for those that every scene has; empty for one scene."""
    names = [name for name in (rows[0] if len(rows) > 1 else ()) if all(name in row for row in rows)]
    return {name: list(interval([row[name] for row in rows])) for name in names}


def stress_digest(size: str, results: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """A summary of the results of `nmpm stress`: its size, how many passed, and which failed."""
    results = list(results)
    return {
        "size": size,
        "passed": sum(result["passed"] is True for result in results),
        "failed": [f"{result['group']}: {result['name']}" for result in results if result["passed"] is False],
    }


CONFIG, WEIGHTS, SCENES = "config.yaml", "model.safetensors", "scenes.csv"
TABLES_AND_PICTURES = ("README.md", SCENES, "errors.csv", "training.csv", "chart.png", "rollout.png", "worst.png")
FILES = (CARD, CONFIG, WEIGHTS, *TABLES_AND_PICTURES)
"""All files of an entry; the tables and pictures may be missing."""
BEST = Path("checkpoints") / "best.ckpt"
"""The best checkpoint within a run's folder."""
LAST = BEST.with_name("last.ckpt")
"""The last checkpoint, of runs without validation the only one."""
WEIGHT_BYTES = 2**33
"""Most that is read of a file of weights."""
Rows = list[dict[str, float]]
"""Figures by their names, of each test scene."""


def read_card(folder: Path) -> dict[str, Any]:
    """The content of an entry's card; raises ZooError if it is missing, damaged or of another format."""
    try:
        card = read_yaml(folder / CARD)
    except DataError as error:
        raise ZooError(str(error)) from error
    if card.get("format") != FORMAT:
        raise ZooError(
            f"{folder / CARD} has format {one_line(card.get('format'), 60)}; this nmpm reads {FORMAT}: use a"
            " version that reads it."
        )
    return card


def read_scenes(folder: Path) -> Rows:
    """The errors of each test scene, from `scenes.csv`; raises ZooError if it is missing or damaged."""
    try:
        lines = csv.DictReader(io.StringIO(read_text(folder / SCENES)), strict=True)
        rows = [{name: float(value) for name, value in line.items() if value} for line in lines]
    except (DataError, csv.Error, TypeError, ValueError, AttributeError) as error:
        raise ZooError(f"The errors of single test scenes are not known: {one_line(error)}") from error
    if not rows or not all(rows):
        raise ZooError(f"{folder / SCENES} states no errors of single test scenes.")
    return rows
