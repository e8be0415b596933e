"""The files of an entry, and its card and tables as they are read; needs no torch."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import read_text, read_yaml
from nmpm._support.messages import one_line
from nmpm.errors import DataError, ZooError
from nmpm.zoo.card import CARD, FORMAT

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
