"""Entries of the zoo that further trainings start from: weights, validation curve, hours and steps of training."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nmpm._support.atomic import atomic_folder
from nmpm._support.bounded_files import read_yaml
from nmpm._support.numbers import is_finite, is_number
from nmpm.errors import ZooError

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
        """The entry in a folder whose card has a curve to go on with; None where there is none.

        Raises:
            DataError: if the card cannot be read.
            ZooError: if what it states of the training is malformed.
        """
        if not (folder / CARD).is_file():
            return None
        card = read_yaml(folder / CARD)
        _check(folder / CARD, card)
        return cls(folder, card) if card.get("curve") else None

    def copy_to(self, folder: Path) -> Published:
        """Copy the entry, so that trainings keep their starting point when the zoo's entry is replaced."""
        with atomic_folder(folder) as new:
            shutil.copytree(self.folder, new, dirs_exist_ok=True)
        return Published(folder, read_yaml(folder / CARD))

    def curve(self) -> list[list[float]]:
        """Seconds of training, steps, MSE and overall error of each validation."""
        return [list(point) for point in self.card.get("curve") or []]

    def seconds(self) -> float:
        """Seconds of training."""
        return float((self.card.get("training") or {}).get("seconds", 0.0))

    def steps(self) -> int:
        """Steps of training."""
        return int((self.card.get("training") or {}).get("steps", 0))

    def last_gain(self, recipe: Mapping[str, str]) -> float | None:
        """Share of the validation error that its last round of training gained.

        Args:
            recipe: Options of the round to come; None is returned where the last one had others or none is stated.
        """
        stated = self.card.get("last_round")
        return float(stated["gain"]) if stated and stated.get("options") == dict(recipe) else None

    def weights(self) -> str:
        """SHA-256 of its weights."""
        return str(self.card.get("sha256", ""))

    def hardware(self) -> str:
        """What it was trained on."""
        return str((self.card.get("training") or {}).get("hardware", ""))


def _check(path: Path, card: Mapping[str, Any]) -> None:
    """Make sure that what a card states of its training can be gone on with.

    Raises:
        ZooError: naming the first key that cannot.
    """
    curve, training, last = (card.get(key) for key in ("curve", "training", "last_round"))
    if curve is not None and not (isinstance(curve, list) and all(_is_point(point) for point in curve)):
        _refuse(path, "curve", "a list of validations: seconds, steps and errors")
    if training is not None and not (
        isinstance(training, Mapping) and all(is_finite(training.get(key, 0)) for key in ("seconds", "steps"))
    ):
        _refuse(path, "training", "a mapping, with numbers of seconds and steps")
    if last is not None and not (
        isinstance(last, Mapping) and all(is_finite(last.get(key)) for key in ("hours", "gain"))
    ):
        _refuse(path, "last_round", "a mapping, with numbers of hours and gain")


def _refuse(path: Path, key: str, needed: str) -> None:
    raise ZooError(f"{path}: {key} should be {needed}; correct it.")


def _is_point(point: object) -> bool:
    return isinstance(point, list) and len(point) > 2 and all(is_number(value) for value in point)
