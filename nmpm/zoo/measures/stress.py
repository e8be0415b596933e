"""The quick stress battery of a model, with its constraints and without them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nmpm.emulator import Emulator
from nmpm.evaluation.stress import Subject, battery
from nmpm.evaluation.stress.lines import QUICK
from nmpm.evaluation.stress.report import as_json
from nmpm.sim import load_preset, preset_names
from nmpm.zoo.cards import stress_digest
from nmpm.zoo.pretrained import Pretrained


def stress_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The keys `stress` and `stress_free` of a card, see `nmpm stress`; takes minutes."""
    return {
        "stress": _digest(model, model.emulator),
        "stress_free": _digest(model, model.emulator.unconstrained()),
    }


def _digest(model: Pretrained, emulator: Emulator) -> dict[str, Any]:
    preset = load_preset(model.preset) if model.preset in preset_names() else None
    lines = list(battery(Subject(model.name, emulator, model.horizon, preset, 0), QUICK))
    return stress_digest(json.loads(as_json(model.name, "quick", 0.0, lines)))
