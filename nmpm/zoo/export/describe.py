"""What an exported file says of itself, as keys and texts; texts of several values are JSON."""

from __future__ import annotations

import dataclasses
import json

import torch

from nmpm._support.version import __version__
from nmpm.zoo.export.parts import Part, Value


def description(part: Part, model: str, training_data: str) -> dict[str, str]:
    """Model, versions, scene, grid, frames, inputs and outputs with their units, and what rollouts are held to.

    Args:
        part: What is exported.
        model: Its name.
        training_data: What it was trained on, in words; simulated data must be called so.
    """
    emulator = part.emulator
    grid = dataclasses.asdict(emulator.grid)
    return {
        "model": model,
        "part": type(part).__name__.lower(),
        "training_data": training_data,
        "generator": f"nmpm {__version__}, torch {torch.__version__}",
        "scene": json.dumps(emulator.scene.to_dict()),
        "grid": json.dumps(grid),
        "frames": str(emulator.frames),
        "dt": repr(emulator.scene.dt),
        "dt_unit": "seconds per frame",
        "constraints": json.dumps(dataclasses.asdict(emulator.constraints)),
        "layout": "contiguous, the last axis fastest",
        "inputs": _values(part.inputs),
        "outputs": _values(part.outputs),
    }


def _values(values: tuple[Value, ...]) -> str:
    return json.dumps({value.name: {"shape": value.shape, "about": value.about} for value in values})
