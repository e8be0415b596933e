"""Write `nmpm/cli/training_options.json`, which `nmpm fit --help` shows and early checks use.

python benchmarks/training_options.py

The classes of model, data and trainer take seconds to import, so their arguments are stored. A test compares them.
"""

from __future__ import annotations

import argparse
import inspect
import json
import re
from importlib import metadata
from types import ModuleType
from typing import Any

from lightning.pytorch import Trainer

from nmpm import (
    EmulatorModule,
    EmulatorRecipe,
    TrajectoryDataModule,
    decoders,
    metrics,
    optimizers,
    processors,
    transfer,
)
from nmpm.cli.command import sections
from nmpm.cli.training_options import OPTIONS_FILE
from nmpm.training import losses

PARTS = (processors, transfer, decoders, losses, optimizers, metrics)
"""Modules whose classes are named in configurations."""
TRAINER = {
    "default_root_dir": "folder of the run's files; further runs go to its version_1, version_2, ...",
    "max_steps": "end of the training in steps, or by max_time, whichever is first",
    "max_time": "end of the training as DD:HH:MM:SS",
    "accelerator": "where to compute: auto, cpu, gpu",
    "devices": "how many devices, see docs/scaling.md",
    "precision": "of the network: bf16-mixed, or 32-true, which CPUs without bfloat16 take in its place",
    "val_check_interval": "steps from validation to validation",
    "enable_progress_bar": "false for none",
}
"""What the help says of arguments of Lightning's Trainer; it lists no others."""


def training_options() -> dict[str, Any]:
    """Arguments of model, data and trainer, those of processors, transfers and decoders, and the names of classes."""
    classes = {"model": (EmulatorModule, EmulatorRecipe), "data": (TrajectoryDataModule,), "trainer": (Trainer,)}
    known: dict[str, Any] = {"lightning": metadata.version("lightning")}
    for group, kinds in classes.items():
        texts = {name: text for kind in kinds for name, text in sections(kind)[1].items()}
        sentences = {name: re.split(r"[.] (?=[A-Z])|[.]$", text)[0] for name, text in texts.items()}
        shown = TRAINER if group == "trainer" else sentences | {"scene": "", "horizon": ""}  # linked
        known[group] = {
            name: _described(parameter) | {"text": shown.get(name, "")}
            for kind in kinds
            for name, parameter in inspect.signature(kind).parameters.items()
            if name != "recipe"
        }
    known["classes"] = {module.__name__: _classes(module) for module in PARTS}
    known["parts"] = {
        name: f"model.{part}.{name}"
        for part, module in (("processor", processors), ("transfer", transfer), ("decoder", decoders), ("loss", losses))
        for kind in _classes(module)
        for name, parameter in inspect.signature(getattr(module, kind)).parameters.items()
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    }
    return known


def _described(parameter: inspect.Parameter) -> dict[str, str | None]:
    """Type and default of an argument, as source code."""
    default, annotation = parameter.default, parameter.annotation
    text = repr(default) if isinstance(default, bool | int | float | str | tuple) else None
    if text is None and default not in (None, parameter.empty):
        text = getattr(default, "__name__", f"{type(default).__name__}()")
    kind = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return {"type": kind, "default": text}


def _classes(module: ModuleType) -> list[str]:
    """Names of the classes of a module of nmpm."""
    kinds = [kind for kind in vars(module).values() if isinstance(kind, type)]
    return sorted({kind.__name__ for kind in kinds if kind.__module__.startswith(module.__name__)})


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    OPTIONS_FILE.write_text(json.dumps(training_options(), indent=1) + "\n", encoding="utf-8")
