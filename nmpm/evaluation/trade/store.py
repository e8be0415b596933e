"""Stored measurements: JSON files by the digest of what determines them, so that an interrupted sweep goes on."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nmpm._support.atomic import atomic_write
from nmpm.evaluation.trade.choice import Prediction, digest


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

    def read_prediction(self, key: Any, scene: str, frames: int) -> Prediction | None:
        """A stored prediction of so many frames, if there is one.

        Those of former versions, which do not say what the choice's own particles gain, are none.
        """
        try:
            with np.load(self._prediction(key, scene), allow_pickle=False) as arrays:
                position, gain = torch.from_numpy(arrays["position"]), float(arrays["gain"])
        except (OSError, ValueError, KeyError):
            return None
        return Prediction(position, None if math.isnan(gain) else gain) if position.shape[1] == frames else None

    def write_prediction(self, key: Any, scene: str, predicted: Prediction) -> None:
        """Store a prediction, if predictions are kept."""
        if self.keep_predictions:
            path = self._prediction(key, scene)
            with atomic_write(path) as part, part.open("wb") as file:
                gain = math.nan if predicted.gain is None else predicted.gain
                np.savez_compressed(file, position=predicted.position.numpy(), gain=np.float64(gain))

    def _path(self, kind: str, key: Any) -> Path:
        return self.folder / "points" / f"{kind}-{digest(key)}.json"

    def _prediction(self, key: Any, scene: str) -> Path:
        return self.folder / "predictions" / digest(key) / f"{scene}.npz"
