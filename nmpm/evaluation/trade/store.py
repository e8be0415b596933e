"""Stored measurements: JSON files by the digest of what determines them, so that an interrupted sweep goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.trade.choice import digest


class Store:
    """Measurements in a folder.

    Args:
        folder: Made when something is written.
        keep_predictions: Whether predictions are stored too, from which errors can be measured anew.
    """

    def __init__(self, folder: Path, keep_predictions: bool = False) -> None:
        self.folder, self.keep_predictions = Path(folder), keep_predictions

    def read(self, kind: str, key: Any) -> dict[str, Any]:
        """What is known, by name; empty if nothing is, or the file is damaged."""
        try:
            stored = json.loads(self._path(kind, key).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        known = stored.get("known") if isinstance(stored, dict) else None
        return known if isinstance(known, dict) else {}

    def write(self, kind: str, key: Any, known: dict[str, Any]) -> None:
        """Replace what is known; the key is written beside it."""
        with atomic_write(self._path(kind, key)) as part:
            part.write_text(json.dumps({"key": key, "known": known}, indent=1) + "\n", encoding="utf-8")

    def read_prediction(self, key: Any, scene: str, frames: int) -> Tensor | None:
        """A stored prediction (1, frames, N, D), if there is one."""
        try:
            with np.load(self._prediction(key, scene), allow_pickle=False) as arrays:
                position = torch.from_numpy(arrays["position"])
        except (OSError, ValueError, KeyError):
            return None
        return position if position.shape[1] == frames else None

    def write_prediction(self, key: Any, scene: str, position: Tensor) -> None:
        """Store a prediction (1, T, N, D), if predictions are kept."""
        if self.keep_predictions:
            path = self._prediction(key, scene)
            with atomic_write(path) as part, part.open("wb") as file:
                np.savez_compressed(file, position=position.cpu().numpy())

    def _path(self, kind: str, key: Any) -> Path:
        return self.folder / "points" / f"{kind}-{digest(key)}.json"

    def _prediction(self, key: Any, scene: str) -> Path:
        return self.folder / "predictions" / digest(key) / f"{scene}.npz"
