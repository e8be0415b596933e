"""Models of one's own trainings: checkpoints, with a card made from the run's report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nmpm._support.bounded_files import read_bounded
from nmpm._support.limits import TEXT_BYTES
from nmpm._support.messages import one_line
from nmpm.emulator import EmulatorRecipe
from nmpm.errors import ConfigError, DataError
from nmpm.zoo.building import bounded_network, read_recipe
from nmpm.zoo.pretrained import Pretrained

if TYPE_CHECKING:
    from nmpm.training.module import EmulatorModule

BEST = Path("checkpoints") / "best.ckpt"


def load_checkpoint(path: Path) -> Pretrained:
    """The model of a checkpoint, on the CPU; nothing in the file is executed.

    Its card has the training horizon and, where the run's `report.json` is found, the dataset and how it was trained;
    test errors only with the checkpoint that they are of, `best.ckpt`.

    Raises:
        DataError: if the file cannot be read, or is not a checkpoint of an emulator.
        ConfigError: if a newer nmpm wrote it, or it names a part that is not known.
    """
    module = _load_module(path)
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


def _load_module(path: Path) -> EmulatorModule:
    """The module of a checkpoint, after its size has been checked."""
    from nmpm.training.checkpoints import load_module, read_checkpoint  # imports Lightning, which entries do without

    try:
        stored = read_checkpoint(path).get("hyper_parameters")
        if not isinstance(stored, dict) or not isinstance(stored.get("unroll"), int):
            raise DataError(f"{path} is not a checkpoint of an emulator: it lacks hyperparameters, such as unroll.")
        names = [field.name for field in dataclasses.fields(EmulatorRecipe)]
        read_recipe({name: stored[name] for name in names if name in stored})
        with bounded_network():
            return load_module(path)
    except (ConfigError, DataError) as error:
        raise type(error)(one_line(error, 600)) from error
    except Exception as error:  # values from anywhere may raise anything
        reason = f"{type(error).__name__}: {one_line(error, 300)}"
        raise DataError(f"{path} is not a checkpoint of an emulator of this version ({reason}).") from error


def _report(path: Path) -> dict[str, Any]:
    """The report of a run; empty if there is none that can be read, as a model rolls out without."""
    try:
        report = json.loads(read_bounded(path, 16 * TEXT_BYTES))
    except (DataError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}
