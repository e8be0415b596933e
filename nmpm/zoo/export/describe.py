"""Metadata of exported files, as keys and texts; lists and mappings are JSON."""

from __future__ import annotations

import dataclasses
import json

import torch

from nmpm._support.version import __version__
from nmpm.zoo.export.parts import Part, Value


def description(part: Part, model: str, training_data: str) -> dict[str, str]:
    """Model, versions, scene, grid, frames, constraints, and inputs and outputs with their units.

    Args:
        part: The exported part.
        model: The model's name.
        training_data: What it was trained on, in words; simulated data must be called simulated.
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
    return json.dumps({value.name: {"shape": value.shape, "description": value.description} for value in values})
