"""Entries of the zoo that further trainings start from: weights, validation curve, hours and steps of training."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_folder
from nmpm._support.bounded_files import read_yaml

CARD = "card.yaml"


@dataclass(frozen=True)
class Published:
    """An entry of the zoo, or a copy of one.

    Args:
        folder: With its card, configuration and weights.
        card: The content of its card.
    """

    folder: Path
    card: Mapping[str, Any] = field(compare=False, repr=False)

    @classmethod
    def find(cls, folder: Path) -> Published | None:
        """The entry in a folder whose card has a curve to go on with; None where there is none."""
        if not (folder / CARD).is_file():
            return None
        entry = cls(folder, read_yaml(folder / CARD))
        return entry if entry.curve() else None

    def copy_to(self, folder: Path) -> Published:
        """Copy the entry, so that trainings keep their starting point when the zoo's entry is replaced."""
        with atomic_folder(folder) as new:
            shutil.copytree(self.folder, new, dirs_exist_ok=True)
        return Published(folder, read_yaml(folder / CARD))

    def curve(self) -> list[list[float]]:
        """Seconds of training, steps, MSE and overall error of each validation."""
        return [list(point) for point in self.card.get("curve", [])]

    def seconds(self) -> float:
        """Seconds of training."""
        return float(self.card.get("training", {}).get("seconds", 0.0))

    def steps(self) -> int:
        """Steps of training."""
        return int(self.card.get("training", {}).get("steps", 0))

    def last_gain(self) -> float | None:
        """Share of the validation error that its last round of training gained; None where its card states none."""
        gain = self.card.get("last_round", {}).get("gain")
        return None if gain is None else float(gain)

    def weights(self) -> str:
        """SHA-256 of its weights."""
        return str(self.card.get("sha256", ""))

    def hardware(self) -> str:
        """What it was trained on."""
        return str(self.card.get("training", {}).get("hardware", ""))
