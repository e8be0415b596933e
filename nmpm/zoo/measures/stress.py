"""The quick stress battery of a model, with its constraints and without them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from nmpm._support.progress import progress_bar
from nmpm.evaluation.stress import GROUPS, Line, Subject, battery
from nmpm.evaluation.stress.lines import QUICK
from nmpm.evaluation.stress.report import as_json
from nmpm.sim import Preset, load_preset, preset_names
from nmpm.zoo.cards import stress_digest
from nmpm.zoo.pretrained import Pretrained

_SETTLING = "settling"


def stress_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The keys `stress` and `stress_free` of a card, see `nmpm stress`; takes minutes, for SPH more than an hour."""
    return _measure(model, load_preset(model.preset) if model.preset in preset_names() else None, "quick")


def invariant_facts(model: Pretrained, folder: Path, data: Path | None) -> dict[str, Any]:  # noqa: ARG001
    """The same keys from tests of invariants alone, without the simulator: from a thrown block, in minutes."""
    return _measure(model, None, "quick, without the simulator")


def _measure(model: Pretrained, preset: Preset | None, size: str) -> dict[str, Any]:
    held = Subject(model.name, model.emulator, model.horizon, preset, 0)
    free = held.with_emulator(model.emulator.unconstrained())
    others = [name for name in GROUPS if name != _SETTLING]
    with progress_bar(f"stress of {model.name}", len(GROUPS) + len(others)) as advance:
        lines = _run_groups(held, GROUPS, advance)
        # The last line of this group is the one without constraints; its simulations are most of the battery's time.
        unheld = _run_groups(free, others, advance) | {_SETTLING: lines[_SETTLING][-1:]}
    return {"stress": _digest(model, lines, size), "stress_free": _digest(model, unheld, size)}


def _run_groups(subject: Subject, names: Iterable[str], advance: Callable[[], object]) -> dict[str, list[Line]]:
    found = {}
    for name in names:
        found[name] = list(battery(subject, QUICK, {name: GROUPS[name]}))
        advance()
    return found


def _digest(model: Pretrained, lines: dict[str, list[Line]], size: str) -> dict[str, Any]:
    ordered = [line for name in GROUPS for line in lines[name]]
    return stress_digest(json.loads(as_json(model.name, size, 0.0, ordered)))
