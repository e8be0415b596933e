"""Models of one's own trainings: checkpoints, with a card of what their run says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nmpm._support.bounded_files import read_bounded
from nmpm._support.limits import TEXT_BYTES
from nmpm.errors import DataError
from nmpm.zoo.pretrained import Pretrained

BEST = Path("checkpoints") / "best.ckpt"


def load_checkpoint(path: Path) -> Pretrained:
    """The model of a checkpoint, on the CPU; nothing in the file is executed.

    Its card has the training horizon and, where the run's `report.json` is found, the dataset and how it was trained;
    test errors only with the checkpoint that they are of, `best.ckpt`.

    Raises:
        DataError: if the file cannot be read, or is not a checkpoint of an emulator.
        ConfigError: if a newer nmpm wrote it, or it names a part that is not known.
    """
    from nmpm.training.checkpoints import load_module  # imports Lightning, which zoo entries do without

    module = load_module(path)
    report = _report(path.parent.parent / "report.json") if path.parent.name == BEST.parent.name else {}
    keys = ("dataset", "versions", *(("test",) if path.name == BEST.name else ()))
    training = report.get("training")
    card = {
        "name": str(path),
        "dataset": "not stated by the checkpoint",
        **{key: report[key] for key in keys if key in report},
        "training": (training if isinstance(training, dict) else {})
        | {"horizon": module.emulator.frames * module.unroll},
    }
    return Pretrained(module.emulator.eval().requires_grad_(False), card)


def _report(path: Path) -> dict[str, Any]:
    """The report of a run; empty if there is none that can be read, as a model rolls out without."""
    try:
        report = json.loads(read_bounded(path, 16 * TEXT_BYTES))
    except (DataError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}
